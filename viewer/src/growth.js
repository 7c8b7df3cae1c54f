// The map of a flight that explored, as it grew: its skin at the time shown, and the camera at each view so far.
import { BufferAttribute, BufferGeometry, Group, LineBasicMaterial, LineSegments, Mesh } from "three";
import { MAP, REFUSED, VIEW } from "./colours.js";
import { indexed, shell } from "./scene.js";

const SMALL = 1 / 40; // of the scene: the pyramids of views that are over

export class Growth {
  constructor(told, span) {
    this.told = told;
    this.skins = told.stages.map(({ vertices, faces }) => {
      const geometry = indexed(vertices, faces);
      geometry.computeVertexNormals();
      const mesh = new Mesh(geometry, shell(MAP, 0.16, 0.55));
      mesh.renderOrder = 2;
      return mesh;
    });
    this.map = new Group().add(...this.skins);
    const count = told.views.time.length;
    const all = Array.from({ length: count }, (_, view) => view);
    this.small = { seen: pyramids(told, all.filter((view) => told.views.taken[view]), span * SMALL, VIEW, 0.3), refused: pyramids(told, all.filter((view) => !told.views.taken[view]), span * SMALL, REFUSED, 0.9) };
    this.large = all.map((view) => pyramids(told, [view], told.reach, told.views.taken[view] ? VIEW : REFUSED, 0.75));
    this.views = new Group().add(this.small.seen, this.small.refused, ...this.large);
  }

  // Shows what there was at a time: the last skin and view not after it.
  move(time) {
    this.stage = last(this.told.stages.map((stage) => stage.time), time);
    this.view = last(this.told.views.time, time);
    this.skins.forEach((mesh, k) => { mesh.visible = k === this.stage; });
    this.large.forEach((lines, k) => { lines.visible = k === this.view; });
    for (const lines of Object.values(this.small)) lines.geometry.setDrawRange(0, CORNERS.length * lines.userData.views.filter((view) => view <= this.view).length);
  }

  words() {
    if (this.view < 0) return "no view yet";
    const { taken, free_volume } = this.told.views;
    return `view ${this.view + 1} of ${taken.length}${taken[this.view] ? "" : ", refused"}, ${free_volume[this.view].toFixed(0)} m³ known free`;
  }
}

function last(times, time) {
  let place = -1;
  while (place + 1 < times.length && times[place + 1] <= time + 1e-6) place += 1;
  return place;
}

const CORNERS = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1]; // of a pyramid's eight edges; 0 is the camera

function pyramids({ views, slopes }, chosen, length, colour, opacity) {
  const places = new Float32Array(3 * CORNERS.length * chosen.length);
  chosen.forEach((view, k) => {
    const at = views.position.subarray(3 * view, 3 * view + 3);
    const axis = (of) => views.axes.subarray(9 * view + 3 * of, 9 * view + 3 * of + 3);
    const [x, y, z] = [axis(0), axis(1), axis(2)];
    const corner = (across, down) => [0, 1, 2].map((k) => at[k] + length * (z[k] + across * slopes[0] * x[k] + down * slopes[1] * y[k]));
    const points = [Array.from(at), corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    places.set(CORNERS.flatMap((point) => points[point]), 3 * CORNERS.length * k);
  });
  const lines = new LineSegments(new BufferGeometry().setAttribute("position", new BufferAttribute(places, 3)), new LineBasicMaterial({ color: colour, transparent: true, opacity }));
  lines.frustumCulled = false;
  lines.userData.views = chosen;
  return lines;
}
