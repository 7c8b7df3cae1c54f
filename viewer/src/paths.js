// A flight: its path, flown and to come, its chaser, and where it is at a time, in the frame that is shown.
import { BoxGeometry, BufferAttribute, Color, GreaterDepth, Group, Mesh, MeshBasicMaterial, Quaternion, SphereGeometry, Vector3 } from "three";
import { Line2 } from "three/examples/jsm/lines/Line2.js";
import { LineGeometry } from "three/examples/jsm/lines/LineGeometry.js";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { mergeGeometries } from "three/examples/jsm/utils/BufferGeometryUtils.js";
import { rowAt } from "./data.js";
import { shell, solid } from "./scene.js";

const POINT_RADIUS = 0.1; // m: a chaser without extent is drawn so large, for something to be seen

// A body with two wings within the ball: its shape is no part of a scenario, only the ball is.
function craft(radius, colour) {
  const bus = new BoxGeometry(0.62, 0.62, 0.78);
  const left = new BoxGeometry(0.04, 0.52, 0.46).translate(0, 0.6, 0);
  const right = new BoxGeometry(0.04, 0.52, 0.46).translate(0, -0.6, 0);
  const tint = [new Color("#e9edf3"), new Color(colour), new Color(colour)];
  const parts = [bus, left, right].map((part, k) => {
    const colours = new Float32Array(part.attributes.position.count * 3);
    for (let at = 0; at < colours.length; at += 3) colours.set([tint[k].r, tint[k].g, tint[k].b], at);
    return part.setAttribute("color", new BufferAttribute(colours, 3));
  });
  const mesh = new Mesh(mergeGeometries(parts), solid());
  mesh.scale.setScalar(radius);
  return mesh;
}

export class Flight {
  constructor(told, colour, scale, grain, dashed) {
    Object.assign(this, told);
    this.colour = colour;
    this.dashed = dashed; // its colour is another's too
    this.grain = grain;
    this.length = this.time[this.rows - 1];
    this.shown = true;
    this.group = new Group();
    this.chaser = new Group();
    this.chaser.add(craft(this.radius || POINT_RADIUS, colour));
    if (this.radius > 0) {
      this.ball = new Mesh(new SphereGeometry(this.radius, 40, 24), shell("#ffffff", 0.1, 0.85));
      this.ball.renderOrder = 5;
      this.chaser.add(this.ball);
    }
    this.chaser.add(ghost(this.radius || POINT_RADIUS, colour));
    this.byClearance = Float32Array.from({ length: 3 * this.rows });
    this.byFlight = Float32Array.from({ length: 3 * this.rows });
    const own = new Color(colour);
    for (let row = 0; row < this.rows; row++) {
      const tint = new Color().setRGB(...scale.colour(this.clearance[row]), "srgb");
      this.byClearance.set([tint.r, tint.g, tint.b], 3 * row);
      this.byFlight.set([own.r, own.g, own.b], 3 * row);
    }
    const dash = dashed ? 12 * grain : 0;
    this.flown = line(4, 1, dash);
    this.ahead = line(2, 0.4, dash);
    this.ahead.material.depthTest = false; // where the target hides a path, it is faint
    this.ahead.renderOrder = 4;
    this.group.add(this.ahead, this.flown, this.chaser);
    this.colours = this.byClearance;
    this.frame = "body";
    this.draw();
  }

  // The rotation from body axes to the axes of a frame at a row and a share of the step after it.
  turn(frame, row, share, into) {
    if (frame === "body") return into.identity();
    const turns = frame === "vvlh" ? this.to_vvlh : this.to_inertial;
    const next = Math.min(row + 1, this.rows - 1);
    const part = [0, 1, 2, 3].map((k) => turns[4 * row + k] + share * (turns[4 * next + k] - turns[4 * row + k]));
    return into.set(part[1], part[2], part[3], part[0]).normalize();
  }

  vector(array, row, share, into) {
    const next = Math.min(row + 1, this.rows - 1);
    const part = [0, 1, 2].map((k) => array[3 * row + k] + share * (array[3 * next + k] - array[3 * row + k]));
    return into.set(...part);
  }

  number(array, row, share) {
    const next = Math.min(row + 1, this.rows - 1);
    return array[row] + share * (array[next] - array[row]);
  }

  // Rows nearer to the one before than a thousandth of the scene are left out of the line: a chaser at rest has many.
  draw() {
    const places = new Float32Array(3 * this.rows);
    const at = new Vector3();
    const kept = new Vector3();
    const turned = new Quaternion();
    this.drawn = [];
    for (let row = 0; row < this.rows; row++) {
      this.vector(this.position, row, 0, at).applyQuaternion(this.turn(this.frame, row, 0, turned));
      places.set([at.x, at.y, at.z], 3 * row);
      if (row > 0 && row < this.rows - 1 && at.distanceTo(kept) < this.grain) continue;
      this.drawn.push(row);
      kept.copy(at);
    }
    this.places = places;
    const line = Float32Array.from(this.drawn.flatMap((row) => [places[3 * row], places[3 * row + 1], places[3 * row + 2]]));
    for (const drawn of [this.flown, this.ahead]) {
      drawn.geometry.setPositions(line);
      drawn.computeLineDistances();
    }
    this.recolour();
  }

  paint(byFlight) {
    this.colours = byFlight ? this.byFlight : this.byClearance;
    this.recolour();
  }

  recolour() {
    const { colours } = this;
    const line = Float32Array.from(this.drawn.flatMap((row) => [colours[3 * row], colours[3 * row + 1], colours[3 * row + 2]]));
    for (const drawn of [this.flown, this.ahead]) drawn.geometry.setColors(line);
  }

  inFrame(frame) {
    if (frame === this.frame) return;
    this.frame = frame;
    this.draw();
  }

  // Moves the chaser to a time; its position and attitude in the frame are then `at` and `attitude`.
  move(time) {
    const [row, share] = rowAt(this, time);
    this.row = row;
    this.part = share;
    this.attitude = this.turn(this.frame, row, share, this.attitude ?? new Quaternion());
    this.at = this.vector(this.position, row, share, this.at ?? new Vector3()).applyQuaternion(this.attitude);
    this.chaser.position.copy(this.at);
    this.chaser.quaternion.copy(this.attitude);
    let segments = this.drawn.findIndex((drawn) => drawn > row);
    segments = (segments === -1 ? this.drawn.length : segments) - 1;
    this.flown.geometry.instanceCount = Math.max(segments, 1);
    this.flown.visible = segments > 0;
  }
}

// Lines of the chaser's ball where something hides it: drawn after the target and before its path, by what lies behind.
function ghost(radius, colour) {
  const mesh = new Mesh(new SphereGeometry(radius, 16, 10), new MeshBasicMaterial({ color: colour, wireframe: true, depthFunc: GreaterDepth, depthWrite: false }));
  mesh.renderOrder = 0.5;
  return mesh;
}

function line(width, opacity, dash) {
  const material = new LineMaterial({ linewidth: width, vertexColors: true, transparent: opacity < 1, opacity, worldUnits: false, dashed: dash > 0, dashSize: dash, gapSize: 0.7 * dash });
  const made = new Line2(new LineGeometry(), material);
  made.frustumCulled = false;
  made.renderOrder = 1;
  return made;
}
