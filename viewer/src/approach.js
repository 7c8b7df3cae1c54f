// Zones, corridors and hold points of a flight: clear bodies, there while they stand, turned as their axes are.
import { BoxGeometry, BufferGeometry, DoubleSide, EdgesGeometry, Float32BufferAttribute, Group, LatheGeometry, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, OctahedronGeometry, SphereGeometry, Vector2, Vector3 } from "three";
import { CORRIDOR, LEG, ZONE } from "./colours.js";
import { element } from "./layout.js";
import { shell } from "./scene.js";

const COLOURS = { zone: ZONE, corridor: CORRIDOR };
const AROUND = 64; // corners of a circle

export class Approach {
  constructor(told, span) {
    this.bodies = told.bodies.map((of) => ({ ...of, drawn: drawn(of), row: element("li", {}, element("i", { style: `background:${COLOURS[of.kind]}` }), of.name) }));
    const mark = new OctahedronGeometry(span / 120);
    this.holds = told.holds.slice(0, -1).map(({ name, position }) => { // the last is the goal
      const drawn = new Mesh(mark, new MeshBasicMaterial({ color: LEG }));
      drawn.position.set(...position);
      return { drawn, label: element("span", { class: "hold" }, name) };
    });
    this.goal = told.holds.length ? `goal: ${told.holds.at(-1).name}` : "goal";
    this.drawn = new Group().add(...[...this.bodies, ...this.holds].map(({ drawn }) => drawn));
  }

  // Shows what stands at a time for a flight that is moved there; who looks from its chaser would see but a mark near by.
  move(time, flight, show, own) {
    for (const { kind, axes, start, until, drawn, row } of this.bodies) {
      const stands = start <= time && (until === null || time < until);
      drawn.visible = stands && show[kind];
      row.className = stands ? "" : "over";
      flight.turn(axes, flight.row, flight.part, drawn.quaternion).invert();
    }
    for (const { drawn } of this.holds) drawn.visible = show.ends && !own;
  }
}

// One body in its own axes, with lines where it has edges.
function drawn(of) {
  const form = of.corners ? triangles(of) : of.profile ? new LatheGeometry(of.profile.map((point) => new Vector2(...point)), AROUND) : of.size ? new BoxGeometry(...of.size) : new SphereGeometry(1, AROUND, AROUND / 2);
  const body = new Mesh(form, shell(COLOURS[of.kind], 0.08, 0.4));
  body.material.side = DoubleSide;
  body.renderOrder = 3.5;
  const edges = new LineSegments(new EdgesGeometry(form, 30), new LineBasicMaterial({ color: COLOURS[of.kind], transparent: true, opacity: 0.5 }));
  const placed = new Group().add(body, edges);
  placed.position.set(...of.at);
  if (of.profile) placed.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), new Vector3(...of.axis));
  if (of.semi_axes) placed.scale.set(...of.semi_axes);
  return new Group().add(placed);
}

// A mesh, each triangle with corners of its own, so that faces are flat.
function triangles({ corners, faces }) {
  const form = new BufferGeometry();
  form.setAttribute("position", new Float32BufferAttribute(faces.flat().flatMap((k) => corners[k]), 3));
  form.computeVertexNormals();
  return form;
}
