// Three cameras in one: free, from the chaser, from the goal.
import { PerspectiveCamera, Quaternion, Vector3 } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const FIELD_OF_VIEW = 38;

export class Eye {
  constructor(canvas, extent, changed) {
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, extent.length / 500, extent.length * 60);
    this.extent = extent;
    this.mode = "free";
    this.aside = 0;
    this.yaw = 0;
    this.pitch = 0;
    this.changed = changed;
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.minDistance = extent.length / 40;
    this.controls.maxDistance = extent.length * 15;
    this.controls.addEventListener("change", changed);
    canvas.addEventListener("pointerdown", (event) => { this.held = this.mode === "free" ? null : event; });
    addEventListener("pointerup", () => { this.held = null; });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("wheel", (event) => this.zoom(event), { passive: false });
  }

  // Fits the picture to the stage; its middle lies a share of the width to the right of the controls' side.
  resize(width, height) {
    const { camera } = this;
    camera.aspect = width / height;
    this.aside = this.mode === "free" && width > 700 ? 60 / width : 0;
    camera.setViewOffset(width, height, -this.aside * width, 0, width, height);
  }

  drag(event) {
    if (!this.held || this.mode === "free") return;
    this.yaw -= (event.clientX - this.held.clientX) * 0.004;
    this.pitch = Math.min(1.4, Math.max(-1.4, this.pitch - (event.clientY - this.held.clientY) * 0.004));
    this.held = event;
    this.changed();
  }

  zoom(event) {
    if (this.mode === "free") return;
    event.preventDefault();
    this.camera.fov = Math.min(90, Math.max(8, this.camera.fov * Math.exp(event.deltaY * 0.001)));
    this.camera.updateProjectionMatrix();
    this.changed();
  }

  // Looks from a little above, from the side on which the paths pass in front of the target, and near enough for the
  // points (of the target, of what is at the ends of the paths, and of the paths) to fill the picture.
  frame(body, ends, paths, up) {
    this.camera.up.copy(up);
    const centre = this.extent.middle;
    const side = Math.abs(up.x) > 0.9 ? new Vector3(0, 1, 0) : new Vector3(1, 0, 0);
    const slope = Math.tan((this.camera.fov * Math.PI) / 360);
    const all = [...body, ...ends, ...paths];
    const views = [];
    for (let k = 0; k < 48; k++) {
      const slant = k < 24 ? 0.44 : -0.35;
      const direction = side.clone().applyAxisAngle(up, ((k + 0.5) * Math.PI) / 12).multiplyScalar(Math.cos(slant)).addScaledVector(up, Math.sin(slant));
      const right = new Vector3().crossVectors(up, direction).normalize();
      const above = new Vector3().crossVectors(direction, right);
      const front = paths.reduce((sum, point) => sum + point.clone().sub(centre).dot(direction), 0) / Math.max(paths.length, 1);
      const wide = span(body, right);
      const seen = [right, above].map((axis) => span(paths, axis)).reduce((sum, [low, high]) => sum + (high - low) ** 2, 0);
      views.push({ direction, right, above, wide: wide[1] - wide[0], seen: Math.sqrt(seen), front: front / this.extent.length, below: k >= 24 });
    }
    // Broad in the picture are both the target and the paths: a view from between their broad sides.
    const most = (of) => Math.max(...views.map(of), 1e-9);
    const [seen, broad] = [most((view) => view.seen), most((view) => view.wide)];
    const score = (view) => Math.min(view.seen / seen, view.wide / broad) + 0.8 * view.front - (view.below ? 0.15 : 0);
    const best = views.reduce((first, second) => (score(second) > score(first) ? second : first));
    const { direction, right, above } = best;
    const breadth = span(all, right);
    const height = span(all, above);
    const depth = span(all, direction);
    const middle = right.clone().multiplyScalar((breadth[0] + breadth[1]) / 2)
      .addScaledVector(above, (height[0] + height[1]) / 2)
      .addScaledVector(direction, (depth[0] + depth[1]) / 2);
    // The distance at which every point is within the picture, with room for what lies over its edges.
    let distance = 0;
    for (const point of all) {
      const from = point.clone().sub(middle);
      const needed = Math.max(Math.abs(from.dot(above)) / (0.78 * slope), Math.abs(from.dot(right)) / (0.93 * slope * this.camera.aspect * (1 - 2 * this.aside)));
      distance = Math.max(distance, from.dot(direction) + needed);
    }
    this.controls.target.copy(middle);
    this.camera.position.copy(middle).addScaledVector(direction, distance);
    this.controls.update();
  }

  set(mode) {
    if (mode === this.mode) return;
    if (this.mode === "free") this.kept = { position: this.camera.position.clone(), target: this.controls.target.clone() };
    this.mode = mode;
    this.yaw = this.pitch = 0;
    this.controls.enabled = mode === "free";
    this.camera.fov = mode === "free" ? FIELD_OF_VIEW : 60;
    this.camera.near = mode === "free" ? this.extent.length / 500 : 0.02;
    this.resize(this.camera.view.fullWidth, this.camera.view.fullHeight);
    if (mode === "free") {
      this.camera.position.copy(this.kept.position);
      this.controls.target.copy(this.kept.target);
      this.controls.update();
    }
    this.changed();
  }

  // Follows the flight: from the chaser along its camera's boresight or, where nothing is said of one, to the near part
  // of the target; or from the goal to the chaser.
  follow(flight, bodyTurn) {
    if (this.mode === "free") return;
    const goal = new Vector3(...flight.goal).applyQuaternion(bodyTurn);
    const at = flight.at;
    const near = at.clone().applyQuaternion(flight.attitude.clone().invert());
    const half = this.extent.upper.clone().sub(this.extent.lower).multiplyScalar(0.3);
    near.sub(this.extent.middle).clamp(half.clone().negate(), half).add(this.extent.middle).applyQuaternion(flight.attitude);
    const from = this.mode === "chaser" ? at : goal;
    const to = this.mode === "chaser" ? near : at;
    const along = this.mode === "chaser" && flight.covered?.boresight.lengthSq() > 0; // its camera's direction
    const direction = along ? flight.covered.boresight.clone().applyQuaternion(bodyTurn) : to.clone().sub(from);
    if (direction.length() > 1e-3) this.direction = direction.normalize();
    if (!this.direction) this.direction = new Vector3(1, 0, 0);
    const up = this.camera.up;
    const across = new Vector3().crossVectors(this.direction, up);
    if (across.length() < 1e-3) across.set(1, 0, 0);
    across.normalize();
    const looking = this.direction.clone()
      .applyQuaternion(new Quaternion().setFromAxisAngle(across, this.pitch))
      .applyQuaternion(new Quaternion().setFromAxisAngle(up, this.yaw));
    this.camera.position.copy(from);
    this.camera.lookAt(from.clone().add(looking));
  }
}

function span(points, direction) {
  let low = Infinity;
  let high = -Infinity;
  for (const point of points) {
    const along = point.dot(direction);
    low = Math.min(low, along);
    high = Math.max(high, along);
  }
  return [low, high];
}
