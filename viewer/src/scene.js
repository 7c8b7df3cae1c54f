// The target, its surfaces and the lights: what does not move with a chaser.
import {
  BufferAttribute, BufferGeometry, Color, DoubleSide, EdgesGeometry, FrontSide, Group, LineBasicMaterial, LineSegments,
  Mesh, Points, PointsMaterial, ShaderMaterial, Vector3,
} from "three";
import { ENVELOPE, GUARD } from "./colours.js";

const BODY = new Color("#c4c9d2");
const EDGES_UP_TO = 60000; // triangles: beyond it their edges would be a grey fog

// Light from over the eye's shoulder, so that no side that is looked at is dark; from the sun, where `sunlit` is 1.
// `n` is the normal on the side that is looked at, in the eye's axes, and `side` -1 where that is the other one.
export const LIGHT = `float key = mix(max(dot(n, normalize(vec3(-0.7, 1.1, 1.0))), 0.0), max(side * dot(normal, sun), 0.0), sunlit), fill = max(dot(n, normalize(vec3(1.2, -0.5, 0.6))), 0.0);
        lit = color * (vec3(0.19, 0.205, 0.235) + 0.68 * key * vec3(1.0, 0.96, 0.9) + 0.17 * fill * vec3(0.62, 0.77, 1.0));`;

// Triangles are flat, so that their light is worked out at corners: a picture without a graphics card takes half the time.
export function solid() {
  return new ShaderMaterial({
    uniforms: { sunlit: { value: 0 }, sun: { value: new Vector3(0, 0, 1) } },
    vertexShader: `attribute vec3 color; varying vec3 lit; uniform float sunlit; uniform vec3 sun;
      void main() { vec4 seen = modelViewMatrix * vec4(position, 1.0); gl_Position = projectionMatrix * seen;
        vec3 n = normalize(normalMatrix * normal); float side = dot(n, seen.xyz) > 0.0 ? -1.0 : 1.0; // meshes have flipped faces
        n *= side;
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

// A clear shell: faint where it is looked through, clearer at its rim.
export function shell(colour, faint, rim) {
  return new ShaderMaterial({
    uniforms: { colour: { value: new Color(colour) }, faint: { value: faint }, rim: { value: rim } },
    vertexShader: `varying vec3 n; varying vec3 eye;
      void main() { vec4 seen = modelViewMatrix * vec4(position, 1.0);
        n = normalMatrix * normal; eye = -seen.xyz; gl_Position = projectionMatrix * seen; }`,
    fragmentShader: `uniform vec3 colour; uniform float faint; uniform float rim; varying vec3 n; varying vec3 eye;
      void main() { float across = 1.0 - abs(dot(normalize(n), normalize(eye)));
        gl_FragColor = vec4(colour * (0.75 + 0.5 * across), mix(faint, rim, across * across));
        #include <colorspace_fragment>
      }`,
    transparent: true,
    depthWrite: false,
    side: FrontSide,
  });
}

function corners(target) {
  const { vertices, faces, openness } = target;
  const positions = new Float32Array(3 * faces.length);
  const colours = new Float32Array(3 * faces.length);
  for (let corner = 0; corner < faces.length; corner++) {
    const shade = 0.45 + 0.55 * (openness[Math.floor(corner / 3)] / 255);
    for (let axis = 0; axis < 3; axis++) positions[3 * corner + axis] = vertices[3 * faces[corner] + axis];
    colours.set([BODY.r * shade, BODY.g * shade, BODY.b * shade], 3 * corner);
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  geometry.setAttribute("color", new BufferAttribute(colours, 3));
  geometry.computeVertexNormals(); // no corner is shared, so each triangle is flat
  return geometry;
}

export function indexed(vertices, faces) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(vertices, 3));
  geometry.setIndex(new BufferAttribute(faces, 1));
  return geometry;
}

export function body(target) {
  const group = new Group();
  if (target.faces.length === 0) {
    const material = new PointsMaterial({ color: BODY, size: Math.max(2 * target.ball_radius, 0.01) });
    group.add(new Points(new BufferGeometry().setAttribute("position", new BufferAttribute(target.vertices, 3)), material));
    return group;
  }
  group.add(new Mesh(corners(target), solid()));
  if (target.faces.length / 3 <= EDGES_UP_TO) {
    const edges = new EdgesGeometry(indexed(target.vertices, target.faces), 30);
    group.add(new LineSegments(edges, new LineBasicMaterial({ color: "#101318", transparent: true, opacity: 0.45 })));
  }
  return group;
}

export function surface(of) {
  const geometry = indexed(of.vertices, of.faces);
  geometry.setAttribute("normal", new BufferAttribute(of.normals, 3, true));
  const mesh = new Mesh(geometry, of.kind === "guard" ? shell(GUARD, 0.07, 0.55) : shell(ENVELOPE, 0.09, 0.6));
  mesh.renderOrder = of.kind === "guard" ? 3 : 2;
  return mesh;
}

export function size(scene) {
  const lower = new Vector3(...scene.target.lower);
  const upper = new Vector3(...scene.target.upper);
  return { lower, upper, middle: lower.clone().add(upper).multiplyScalar(0.5), length: upper.distanceTo(lower) };
}
