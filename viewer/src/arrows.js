// Arrows of a vector, and the line to the closest point.
import { ConeGeometry, CylinderGeometry, Group, Mesh, MeshBasicMaterial, SphereGeometry, Vector3 } from "three";

const UP = new Vector3(0, 1, 0);

export class Arrow extends Group {
  constructor(colour, width) {
    super();
    this.width = width;
    const material = new MeshBasicMaterial({ color: colour });
    this.shaft = new Mesh(new CylinderGeometry(1, 1, 1, 10).translate(0, 0.5, 0), material);
    this.head = new Mesh(new ConeGeometry(2.6, 6.5, 16).translate(0, 3.25, 0), material);
    this.add(this.shaft, this.head);
    this.wanted = true;
  }

  // From a point along a vector whose length is in metres of the drawing.
  set(from, vector) {
    const length = vector.length();
    this.visible = this.wanted && length > 1e-6;
    if (!this.visible) return;
    this.position.copy(from);
    this.quaternion.setFromUnitVectors(UP, vector.clone().divideScalar(length));
    const head = Math.min(6.5 * this.width, 0.6 * length);
    this.head.scale.setScalar(head / 6.5);
    this.head.position.y = length - head;
    this.shaft.scale.set(this.width, length - head, this.width);
  }
}

export class Closest extends Group {
  constructor(colour, width) {
    super();
    this.width = width;
    const material = new MeshBasicMaterial({ color: colour });
    this.shaft = new Mesh(new CylinderGeometry(1, 1, 1, 8).translate(0, 0.5, 0), material);
    this.dot = new Mesh(new SphereGeometry(3 * width, 16, 12), material);
    this.add(this.shaft, this.dot);
    this.wanted = true;
  }

  set(from, to, radius) {
    const vector = to.clone().sub(from);
    const distance = vector.length();
    this.visible = this.wanted && distance > 1e-6;
    if (!this.visible) return;
    vector.divideScalar(distance);
    this.dot.position.copy(to);
    this.shaft.position.copy(from).addScaledVector(vector, Math.min(radius, distance));
    this.shaft.quaternion.setFromUnitVectors(UP, vector);
    this.shaft.scale.set(this.width * 0.7, Math.max(distance - radius, 1e-6), this.width * 0.7);
  }
}
