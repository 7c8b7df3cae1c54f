// What an inspection saw and when: the surface in the colours of what became of it, the camera's cone, and the sun.
import { BufferAttribute, BufferGeometry, Color, ConeGeometry, DoubleSide, Group, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, ShaderMaterial, Vector3 } from "three";
import { VIEW } from "./colours.js";
import { LIGHT } from "./scene.js";

const [SEEN, MISSED] = [0, 1]; // places in the legend
const RIM = 64; // corners of the circle at the cone's end
const RULERS = 8; // lines from the camera to it

export class Coverage {
  constructor(told) {
    this.told = told;
    this.mesh = new Mesh(corners(told), material(told.legend));
    this.cone = cone(told);
    this.boresight = new Vector3();
    this.sun = new Vector3();
  }

  // Shows what was seen up to a time; the camera is at a place in the body frame.
  move(time, at) {
    const { frames } = this.told;
    let frame = -1;
    while (frame + 1 < frames.time.length && frames.time[frame + 1] <= time + 1e-6) frame += 1;
    this.frame = frame;
    this.mesh.material.uniforms.frame.value = frame;
    const now = Math.max(frame, 0);
    const next = Math.min(now + 1, frames.time.length - 1);
    const part = next > now ? Math.min(Math.max((time - frames.time[now]) / (frames.time[next] - frames.time[now]), 0), 1) : 0;
    between(frames.boresight, now, next, part, this.boresight);
    between(frames.sun, now, next, part, this.sun);
    this.cone.position.copy(at);
    this.cone.quaternion.setFromUnitVectors(new Vector3(0, 0, 1), this.boresight);
  }

  words() {
    const { frames, possible, lit } = this.told;
    if (this.frame < 0) return "no frame yet";
    const dark = lit && this.sun.lengthSq() === 0 ? ", in the Earth's shadow" : "";
    return `frame ${this.frame + 1} of ${frames.time.length}${dark}, ${percent(frames.share[this.frame])} of the surface seen; ${percent(possible)} can be`;
  }
}

export function percent(share) {
  return Number.isFinite(share) ? `${(100 * share).toFixed(1)} %` : "–";
}

// The direction a share of the way from one frame's to the next; nothing where the first has none.
function between(array, now, next, part, into) {
  const [from, to] = [now, next].map((frame) => new Vector3().fromArray(array, 3 * frame));
  if (!Number.isFinite(from.x)) return into.set(0, 0, 0);
  if (!Number.isFinite(to.x)) return into.copy(from);
  into.copy(from).lerp(to, part);
  return into.lengthSq() > 1e-9 ? into.normalize() : into.copy(from);
}

function corners({ vertices, faces, fates, firsts }) {
  const places = new Float32Array(3 * faces.length);
  const [fate, first] = [new Float32Array(2 * faces.length), new Float32Array(2 * faces.length)];
  for (let corner = 0; corner < faces.length; corner++) {
    const face = Math.floor(corner / 3);
    for (let axis = 0; axis < 3; axis++) places[3 * corner + axis] = vertices[3 * faces[corner] + axis];
    for (const side of [0, 1]) {
      fate[2 * corner + side] = fates[2 * face + side];
      first[2 * corner + side] = firsts[2 * face + side];
    }
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(places, 3));
  geometry.setAttribute("fate", new BufferAttribute(fate, 2));
  geometry.setAttribute("first", new BufferAttribute(first, 2));
  geometry.computeVertexNormals(); // no corner is shared, so each triangle is flat
  return geometry;
}

// Each side of a triangle has a colour of its own; what is seen later has that of what is not seen; new is pale.
function material(legend) {
  return new ShaderMaterial({
    uniforms: { sunlit: { value: 0 }, sun: { value: new Vector3(0, 0, 1) }, frame: { value: -1 }, palette: { value: legend.map(({ colour }) => new Color(colour)) } },
    vertexShader: `attribute vec2 fate; attribute vec2 first; varying vec3 lit; uniform float sunlit; uniform vec3 sun; uniform float frame; uniform vec3 palette[${legend.length}];
      void main() { vec4 seen = modelViewMatrix * vec4(position, 1.0); gl_Position = projectionMatrix * seen;
        vec3 n = normalize(normalMatrix * normal); bool back = dot(n, seen.xyz) > 0.0;
        float kind = back ? fate.y : fate.x, at = back ? first.y : first.x;
        bool done = at >= 0.0 && at <= frame;
        int place = int((done ? ${SEEN}.0 : kind == ${SEEN}.0 ? ${MISSED}.0 : kind) + 0.5);
        vec3 color = palette[0];
        for (int k = 1; k < ${legend.length}; k++) if (k == place) color = palette[k];
        if (done && at == frame) color = mix(color, vec3(1.0), 0.4);
        float side = back ? -1.0 : 1.0; n *= side;
        ${LIGHT} }`,
    fragmentShader: `varying vec3 lit;
      void main() { gl_FragColor = vec4(lit, 1.0);
        #include <colorspace_fragment>
      }`,
    side: DoubleSide,
    polygonOffset: true,
    polygonOffsetFactor: 1,
    polygonOffsetUnits: 1,
  });
}

// About the third axis, from the camera as far as it is used.
function cone({ half_angle, reach }) {
  const wide = reach * Math.tan(half_angle);
  const rim = (k) => [wide * Math.cos((2 * Math.PI * k) / RIM), wide * Math.sin((2 * Math.PI * k) / RIM), reach];
  const lines = [];
  for (let k = 0; k < RIM; k++) lines.push(rim(k), rim(k + 1));
  for (let k = 0; k < RIM; k += RIM / RULERS) lines.push([0, 0, 0], rim(k));
  lines.push([0, 0, 0], [0, 0, reach]);
  const geometry = new BufferGeometry().setAttribute("position", new BufferAttribute(Float32Array.from(lines.flat()), 3));
  const drawn = new LineSegments(geometry, new LineBasicMaterial({ color: VIEW, transparent: true, opacity: 0.7 }));
  const filled = new ConeGeometry(wide, reach, RIM, 1, true).rotateX(-Math.PI / 2).translate(0, 0, reach / 2);
  const inside = new Mesh(filled, new MeshBasicMaterial({ color: VIEW, transparent: true, opacity: 0.05, depthWrite: false, side: DoubleSide }));
  inside.renderOrder = 3;
  return new Group().add(drawn, inside);
}
