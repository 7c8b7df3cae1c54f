// The viewer of `keepout replay`: puts the parts together and draws when something has changed.
import { Box3, Group, Mesh, MeshBasicMaterial, OctahedronGeometry, Quaternion, Scene, SphereGeometry, Vector3, WebGLRenderer } from "three";
import { Approach } from "./approach.js";
import { Arrow, Closest } from "./arrows.js";
import { Eye } from "./cameras.js";
import { CLOSEST, CORRIDOR, ENVELOPE, FLIGHTS, GOAL, GUARD, MAP, SAFE_VELOCITY, Scale, START, SUN, THRUST, VIEW, ZONE, ramp } from "./colours.js";
import { Coverage } from "./coverage.js";
import { read } from "./data.js";
import { Growth } from "./growth.js";
import { choice, element, metres, panels, toggle } from "./layout.js";
import { Flight } from "./paths.js";
import { Plots } from "./plots.js";
import "./replay.css";
import { body, shell, size, surface } from "./scene.js";
import { Transport } from "./transport.js";

const FRAMES = { body: ["body", "The target's body axes (B)"], vvlh: ["VVLH", "x along the velocity, z to nadir, y against the orbit normal (V)"], inertial: ["inertial", "Fixed to the stars, ECI axes (I)"] };
const CAMERAS = { free: ["free", "Drag to turn, wheel to zoom (1)"], chaser: ["chaser", "From the chaser's centre to the target (2)"], goal: ["goal", "From the goal to the chaser (3)"] };
const AXES = { body: ["x", "y", "z"], vvlh: ["x velocity", "y", "z nadir"], inertial: ["x", "y", "z pole"] };
const TRIAD = ["#ff8a8a", "#8fe388", "#86b6ff"];
const REST = 400; // ms
const KEYS = "space: play or pause · ← →: a step (with shift: ten) · [ ]: marks · Home, End · − +: speed · 1 2 3: camera · B V I: frame · E: envelope · G: guard's level · M: map · C: views, or the camera's cone · P: coverage · Z: zones and corridors · R: view from the start · F: next flight";
const VERDICTS = { no: "No contact, proved", yes: "Contact", undecided: "Contact not excluded" };

class Replay {
  constructor(root, told) {
    this.root = root;
    this.told = told;
    this.frame = "body";
    this.frames = 0; // drawn so far
    this.parts = panels(root, told);
    this.extent = size(told);
    const scale = new Scale(told.flights);
    this.flights = told.flights.map((flight, k) => new Flight(flight, FLIGHTS[k % FLIGHTS.length], scale, this.extent.length / 1000, k >= FLIGHTS.length));
    // Of target and paths together: by it whatever has no size of its own is drawn.
    const paths = new Box3().setFromPoints(this.flights.flatMap((flight) => every(flight.position, 200)));
    this.span = Math.max(this.extent.length, paths.getSize(new Vector3()).length());
    this.start3d();
    this.plots = new Plots(this.parts.plots, this.flights, (time) => { this.transport.pause(); this.transport.seek(time); });
    this.transport = new Transport(this.parts.transport, this.flights, () => this.touch());
    this.controls(scale);
    this.choose(this.named() ?? this.flights[0]);
    new ResizeObserver(() => this.resize()).observe(this.parts.stage);
    this.resize();
    this.update();
    this.look();
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("hashchange", () => { const flight = this.named(); if (flight) this.choose(flight); });
    addEventListener("beforeprint", () => { this.render(); this.parts.still.src = this.parts.canvas.toDataURL("image/png"); });
    this.transport.seek(0);
    this.last = performance.now();
    requestAnimationFrame((now) => this.tick(now));
  }

  start3d() {
    // A drawing without a graphics card is slow: it gets one sample a pixel while something moves, and four at rest.
    this.software = softwareRendering();
    this.renderer = new WebGLRenderer({ canvas: this.parts.canvas, antialias: !this.software, alpha: true, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(this.software ? 1 : Math.min(devicePixelRatio, 2));
    this.scene = new Scene();
    this.eye = new Eye(this.parts.canvas, this.extent, () => this.touch());
    this.scene.add(this.eye.camera);
    this.turning = new Group(); // what is fixed to the target
    this.body = body(this.told.target);
    this.surfaces = this.told.surfaces.map((of) => surface(of));
    const { span } = this;
    this.pen = span / 900;
    this.thrust = new Arrow(THRUST, this.pen * 1.3);
    this.velocity = new Arrow(SAFE_VELOCITY, this.pen * 1.3);
    this.closest = new Closest(CLOSEST, this.pen * 1.2);
    this.sun = new Arrow(SUN, this.pen * 1.6);
    this.sun.shaft.material.depthTest = false; // seen through the target too
    this.goal = new Mesh(new OctahedronGeometry(span / 110), new MeshBasicMaterial({ color: GOAL }));
    this.place = new Mesh(new SphereGeometry(1, 32, 16), shell(GOAL, 0.06, 0.6));
    this.begin = new Mesh(new SphereGeometry(span / 170, 16, 12), new MeshBasicMaterial({ color: START }));
    this.turning.add(this.body, ...this.surfaces, this.thrust, this.velocity, this.closest, this.sun, this.goal, this.place);
    for (const flight of this.flights) if (flight.growth) {
      flight.grown = new Growth(flight.growth, span);
      this.turning.add(flight.grown.map, flight.grown.views);
    }
    for (const flight of this.flights) if (flight.coverage) {
      flight.covered = new Coverage(flight.coverage);
      this.turning.add(flight.covered.mesh, flight.covered.cone);
    }
    for (const flight of this.flights) if (flight.approach) {
      flight.rules = new Approach(flight.approach, span);
      this.turning.add(flight.rules.drawn);
      this.parts.labels.append(...flight.rules.holds.map(({ label }) => label));
    }
    this.scene.add(this.turning, this.begin, ...this.flights.map((flight) => flight.group));
    this.parts.labels.prepend(...["goal", "start"].map((name) => element("span", { class: name }, name)), element("i"));
    this.show = { target: true, envelope: this.surfaces.some((_, k) => this.told.surfaces[k].kind === "envelope"), guard: false, path: true, chaser: true, thrust: true, velocity: true, closest: true, ends: true, sun: true, map: true, views: true, coverage: true, cone: true, zone: true, corridor: true };
    this.goals = this.flights.some((of) => !of.coverage); // who inspects flies to none
  }

  controls(scale) {
    const change = (name) => (checked) => { this.show[name] = checked; this.touch(); };
    const has = (kind) => this.told.surfaces.some((of) => of.kind === kind);
    const ruled = (kind) => this.flights.some((of) => of.rules?.bodies.some((body) => body.kind === kind));
    const one = (kind) => this.told.surfaces.find((of) => of.kind === kind);
    const level = (of) => `the surface ${metres(of.level)} of the field: with the chaser's centre outside there is no contact (${of.proved ? "proved" : "sampled, not proved"}; error bound ${metres(of.error_bound)})`;
    this.toggles = {
      target: toggle("target", "target", "#c4c9d2", true, change("target")),
      ...(has("envelope") && { envelope: toggle("envelope", "certified envelope", ENVELOPE, true, change("envelope"), `Of the learned field: ${level(one("envelope"))} (E)`) }),
      ...(has("guard") && { guard: toggle("guard", "guard's level", GUARD, false, change("guard"), `Of the guard's own field: ${level(one("guard"))} (G)`) }),
      ...(this.flights.some((of) => of.grown) && {
        map: toggle("map", "not known free", MAP, true, change("map"), "The skin of the map at this time: what is inside it was not seen free, and is an obstacle (M)"),
        views: toggle("views", "views", VIEW, true, change("views"), "What the camera looked at: the last view as far as it is used, those before it small (C)"),
      }),
      ...(this.flights.some((of) => of.covered) && {
        coverage: toggle("coverage", "coverage", "linear-gradient(90deg,#d9722e,#2fa77d)", true, change("coverage"), "The surface in the colours below; what the last frame saw first is pale (P)"),
        cone: toggle("cone", "camera", VIEW, true, change("cone"), "What the camera takes in, as far as its range goes; its direction between two frames is blended (C)"),
      }),
      ...(ruled("zone") && { zone: toggle("zone", "zones", ZONE, true, change("zone"), "What no part of the chaser may enter, while it stands (Z)") }),
      ...(ruled("corridor") && { corridor: toggle("corridor", "corridors", CORRIDOR, true, change("corridor"), "The walls that the chaser's centre stays within (Z)") }),
      path: toggle("path", "path", "linear-gradient(90deg,#f0f921,#e16462,#5566d8)", true, change("path")),
      chaser: toggle("chaser", "chaser and its ball", "#ffffff", true, change("chaser")),
      thrust: toggle("thrust", "thrust", THRUST, true, change("thrust")),
      velocity: toggle("velocity", "safe velocity", SAFE_VELOCITY, true, change("velocity")),
      closest: toggle("closest", "closest point", CLOSEST, true, change("closest")),
      ends: toggle("ends", !this.goals ? "start" : this.flights.some((of) => of.rules?.holds.length) ? "goal, holds and start" : "goal and start", GOAL, true, change("ends")),
      ...(this.flights.some((of) => of.sun || of.coverage?.lit) && { sun: toggle("sun", "sun", SUN, true, change("sun"), "The arrow points to the sun, which lights the target") }),
    };
    this.frameChoice = choice("Frame", FRAMES, (frame) => this.inFrame(frame));
    const { goal: _, ...without } = CAMERAS;
    this.cameraChoice = choice("Camera", this.goals ? CAMERAS : without, (mode) => this.from(mode));
    const several = this.flights.length > 1;
    this.colourChoice = choice("Colour", { clearance: ["clearance", "Paths by clearance"], flight: ["flight", "Paths by flight"] }, (by) => this.paint(by));
    this.parts.controls.append(this.cameraChoice, this.frameChoice, ...(several ? [this.colourChoice] : []), element("div", { class: "toggles" }, ...Object.values(this.toggles)), ...this.legend(), this.rules = element("ul", { class: "fates" }),
      element("button", { class: "help", title: KEYS, "aria-label": `Keys: ${KEYS}`, onclick: () => this.parts.stage.classList.toggle("helped") }, "?"));
    this.parts.stage.append(element("p", { class: "keys" }, KEYS));
    this.parts.about.addEventListener("click", () => {
      const figures = document.getElementById("figures");
      figures.classList.toggle("asked");
      if (figures.classList.contains("asked")) figures.scrollIntoView();
    });
    this.frameChoice.show(this.frame);
    this.cameraChoice.show("free");
    const stops = Array.from({ length: 17 }, (_, k) => `rgb(${ramp(k / 16).map((part) => Math.round(255 * part)).join(",")})`);
    this.parts.bar.append(element("span", { class: "title" }, "clearance, m"), element("div", { class: "ramp", style: `background:linear-gradient(90deg,${stops.join(",")})` }),
      element("div", { class: "ticks" }, ...scale.ticks().map((tick) => element("span", { style: `left:${100 * scale.share(tick)}%` }, String(tick)))));
    this.paint(several ? "flight" : "clearance");
    if (!several) return;
    this.chips = new Map(this.flights.map((flight) => {
      const box = element("input", { type: "checkbox", "aria-label": `Show ${flight.name}` });
      box.checked = true;
      box.addEventListener("change", () => { flight.shown = box.checked; this.plots.show(this.flight); this.touch(); });
      const name = element("button", { onclick: () => this.choose(flight), title: "Bring into focus (F: the next)" }, element("i", { class: flight.dashed ? "dashed" : "", style: `color:${flight.colour}` }), flight.name);
      return [flight, { chip: element("span", { class: "chip" }, box, name), box }];
    }));
    this.parts.flights.append(...[...this.chips.values()].map(({ chip }) => chip));
  }

  // What the colours of a surface that is inspected say.
  legend() {
    const [told] = this.flights.flatMap((of) => of.coverage ?? []);
    const rows = (told?.legend ?? []).filter((of) => of.shown).map(({ words, colour }) => element("li", {}, element("i", { style: `background:${colour}` }), words));
    return rows.length ? [element("ul", { class: "fates" }, ...rows)] : [];
  }

  named() {
    const name = decodeURIComponent(location.hash.slice(1));
    return this.flights.find((flight) => flight.name === name);
  }

  choose(flight) {
    this.flight = flight;
    flight.shown = true;
    if (this.chips) for (const [of, { chip, box }] of this.chips) {
      chip.setAttribute("aria-current", String(of === flight));
      box.checked = of.shown;
      box.disabled = of === flight;
    }
    const proved = flight.contact === "no" ? `: clearance ≥ ${metres(Math.floor(1000 * flight.least_clearance) / 1000)} at every instant` : flight.remarks.length ? `: ${flight.remarks[0]}` : "";
    this.parts.verdict.textContent = VERDICTS[flight.contact] + proved;
    this.parts.verdict.title = flight.remarks.join("\n");
    this.parts.verdict.dataset.contact = flight.contact;
    this.parts.note.textContent = [this.told.target.remark, flight.remark, flight.growth?.remark, flight.coverage?.remark].filter(Boolean).join(" "); // what the drawing leaves out
    this.rules.replaceChildren(...(flight.rules?.bodies ?? []).map(({ row }) => row));
    this.parts.labels.firstChild.textContent = flight.rules?.goal ?? "goal";
    this.goal.position.set(...flight.goal);
    this.place.position.set(...flight.goal);
    this.place.scale.setScalar(Math.max(flight.radius, 1e-6));
    this.transport.focus(flight);
    this.plots.show(flight);
    this.touch();
  }

  paint(by) {
    for (const flight of this.flights) flight.paint(by === "flight");
    this.colourChoice.show(by);
    this.parts.bar.hidden = by === "flight";
    this.touch();
  }

  // Nadir is down in VVLH, and in the body frame of a target that is fixed to it; else z is up.
  up() {
    const nadir = this.frame === "vvlh" || (this.frame === "body" && this.flights[0].turns === "vvlh");
    return new Vector3(0, 0, nadir ? -1 : 1);
  }

  look() {
    const body = every(this.told.target.vertices, 4000).map((point) => point.applyQuaternion(this.flight.attitude));
    // The ball at both ends of a path is to be seen whole.
    const ends = this.flights.flatMap((flight) => [0, flight.rows - 1].flatMap((row) => [0, 1, 2].flatMap((axis) => [-1, 1].map((sign) => {
      const at = new Vector3().fromArray(flight.places, 3 * row);
      return at.setComponent(axis, at.getComponent(axis) + sign * flight.radius);
    }))));
    // So is what is not known free at the start.
    const unknown = this.flights.flatMap(({ grown, growth }) => (grown ? every(growth.stages[0].vertices, 200) : []));
    ends.push(...unknown.map((point) => point.applyQuaternion(this.flight.attitude)));
    this.eye.frame(body, ends, this.flights.flatMap((flight) => every(flight.places, 60)), this.up());
  }

  inFrame(frame) {
    this.frame = frame;
    this.frameChoice.show(frame);
    for (const flight of this.flights) flight.inFrame(frame);
    const mode = this.eye.mode;
    this.eye.set("free");
    this.update();
    this.look();
    this.eye.set(mode);
    this.touch();
  }

  from(mode) {
    this.eye.set(mode);
    this.cameraChoice.show(mode);
    this.touch();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.parts.stage;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.eye.resize(width, height);
    this.touch();
  }

  // Four samples a pixel, or one, where there is no graphics card; one that there is takes its own.
  fine(finer) {
    if (!this.software || finer === this.finer) return;
    this.finer = finer;
    this.renderer.setPixelRatio(finer ? 2 : 1);
  }

  touch() {
    this.stale = true;
  }

  tick(now) {
    this.transport.pass(Math.min((now - this.last) / 1000, 0.25));
    this.last = now;
    if (this.stale) {
      this.stale = false;
      this.moved = now;
      this.fine(false);
      this.render();
      this.frames += 1;
      this.root.dataset.ready = "";
    } else if (this.software && !this.finer && now - this.moved > REST) {
      this.fine(true);
      this.render();
    }
    requestAnimationFrame((next) => this.tick(next));
  }

  update() {
    const { flight, show } = this;
    const time = this.transport.time;
    for (const of of this.flights) of.move(time);
    this.turning.quaternion.copy(flight.attitude);
    const { row, part } = flight;
    const at = flight.vector(flight.position, row, part, new Vector3());
    const reach = Math.max(0.09 * this.span, 3 * flight.radius);
    const along = (array, limit) => flight.vector(array, row, 0, new Vector3()).multiplyScalar(reach / limit);
    for (const name of ["thrust", "velocity", "closest"]) this[name].wanted = show[name] && show.chaser;
    const force = along(flight.applied_force, flight.force_limit);
    const velocity = along(flight.safe_velocity, flight.speed_limit);
    this.thrust.set(tip(at, force, flight.radius), force);
    this.velocity.set(tip(at, velocity, flight.radius), velocity);
    this.closest.set(at, flight.vector(flight.closest, row, part, new Vector3()), flight.radius);
    for (const { covered } of this.flights) if (covered) {
      if (covered === flight.covered) covered.move(time, at);
      covered.mesh.visible = show.target && show.coverage && covered === flight.covered;
      covered.cone.visible = show.cone && covered === flight.covered && covered.told.frames.time.length > 0;
      covered.cone.children[1].visible = this.eye.mode === "free";
    }
    this.light(flight, row);
    const own = this.eye.mode === "chaser";
    for (const of of this.flights) {
      of.group.visible = of.shown;
      of.flown.visible &&= show.path;
      of.ahead.visible = show.path;
      of.chaser.visible = show.chaser && !(own && of === flight);
    }
    this.body.visible = show.target;
    this.body.children[0].visible = !(flight.covered && show.coverage);
    this.surfaces.forEach((mesh, k) => { mesh.visible = flight.surfaces.includes(k) && show[this.told.surfaces[k].kind]; });
    for (const { grown } of this.flights) if (grown) {
      grown.move(time);
      grown.map.visible = show.map && grown === flight.grown;
      grown.views.visible = show.views && grown === flight.grown;
    }
    for (const { rules } of this.flights) if (rules) {
      rules.drawn.visible = rules === flight.rules;
      rules.move(time, flight, show, own);
    }
    const [x, y, z] = flight.places;
    this.begin.position.set(x, y, z);
    this.goal.visible = this.place.visible = show.ends && this.eye.mode !== "goal" && !flight.coverage;
    this.begin.visible = show.ends;
    this.eye.follow(flight, flight.attitude);
  }

  // From the sun, where the flight has one.
  light(flight, row) {
    const inspected = flight.coverage?.lit; // then nothing in the Earth's shadow
    const lit = Boolean(inspected || flight.sun) && this.show.sun;
    const toward = !lit ? new Vector3() : inspected ? flight.covered.sun.clone() : flight.vector(flight.sun, row, 0, new Vector3()).normalize();
    const shines = toward.lengthSq() > 0;
    this.sun.wanted = shines;
    this.sun.visible = shines;
    for (const { uniforms } of [this.body.children[0].material, ...(flight.covered ? [flight.covered.mesh.material] : [])]) if (uniforms) {
      uniforms.sunlit.value = lit ? 1 : 0;
      if (lit) uniforms.sun.value.copy(toward);
    }
    if (!shines) return;
    this.sun.set(toward.clone().multiplyScalar(0.3 * this.span), toward.clone().multiplyScalar(0.12 * this.span));
  }

  render() {
    this.update();
    this.renderer.render(this.scene, this.eye.camera);
    this.plots.move(this.transport.time);
    this.overlays();
  }

  overlays() {
    const { camera } = this.eye;
    const { clientWidth: width, clientHeight: height } = this.parts.stage;
    const [goal, start, ring] = this.parts.labels.children;
    const put = (label, at, shown) => {
      const seen = at.clone().project(camera);
      label.hidden = !shown || seen.z > 1 || Math.abs(seen.x) > 1 || Math.abs(seen.y) > 1;
      label.style.transform = `translate(${((seen.x + 1) * width) / 2 + 10}px,${((1 - seen.y) * height) / 2 - 9}px)`;
    };
    put(goal, this.goal.getWorldPosition(new Vector3()), this.goal.visible);
    for (const { rules } of this.flights) for (const { drawn, label } of rules?.holds ?? []) put(label, drawn.getWorldPosition(new Vector3()), this.show.ends && rules === this.flight.rules);
    put(start, this.begin.position, this.begin.visible);
    const { flight } = this;
    const away = camera.position.distanceTo(flight.at);
    const pixels = (flight.radius * height) / (away * Math.tan((camera.fov * Math.PI) / 360));
    put(ring, flight.at, flight.chaser.visible && pixels < 10); // a ring leads the eye to a chaser that is small on the screen
    const back = camera.getWorldQuaternion(new Quaternion()).invert();
    const arms = [0, 1, 2].map((k) => ({ k, to: new Vector3().setComponent(k, 38).applyQuaternion(back) })).sort((a, b) => a.to.z - b.to.z);
    this.parts.triad.innerHTML = arms.map(({ k, to }) => `<line x2="${to.x.toFixed(1)}" y2="${(-to.y).toFixed(1)}" stroke="${TRIAD[k]}" stroke-width="2.5" stroke-linecap="round" opacity="${to.z < -5 ? 0.55 : 1}"/><text x="${(to.x * 1.27).toFixed(1)}" y="${(-to.y * 1.27 + 4).toFixed(1)}" fill="${TRIAD[k]}">${AXES[this.frame][k]}</text>`).join("");
    this.parts.status.textContent = this.words();
  }

  words() {
    const { flight } = this;
    const row = Math.min(flight.row, flight.rows - 2);
    const now = flight.marks.filter((mark) => ["guard", "flag", "law"].includes(mark.kind) && mark.start <= this.transport.time && this.transport.time < mark.end);
    const spoken = [...new Set(now.map((mark) => mark.words))];
    if (spoken.length === 0) spoken.push(flight.guarded ? (flight.guard[row] === 0 ? "guard: command passed on" : "guard") : "no guard");
    const leg = flight.marks.find((mark) => mark.kind === "leg" && mark.start <= this.transport.time && this.transport.time < mark.end);
    if (leg) spoken.unshift(leg.words);
    if (flight.grown) spoken.push(flight.grown.words());
    if (flight.covered) spoken.push(flight.covered.words());
    return spoken.join(" · ");
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target instanceof HTMLSelectElement) return;
    const { transport } = this;
    const flip = (name) => { const of = this.toggles[name]; if (of) of.box.click(); };
    const step = event.shiftKey ? 10 : 1;
    const does = {
      " ": () => transport.toggle(),
      ArrowLeft: () => transport.step(-step),
      ArrowRight: () => transport.step(step),
      Home: () => transport.seek(0),
      End: () => transport.seek(transport.end),
      "[": () => transport.jump(-1),
      "]": () => transport.jump(1),
      "-": () => transport.next(-1),
      "+": () => transport.next(1),
      "=": () => transport.next(1),
      1: () => this.from("free"),
      2: () => this.from("chaser"),
      3: () => this.goals && this.from("goal"),
      b: () => this.inFrame("body"),
      v: () => this.inFrame("vvlh"),
      i: () => this.inFrame("inertial"),
      e: () => flip("envelope"),
      g: () => flip("guard"),
      m: () => flip("map"),
      c: () => { flip("views"); flip("cone"); },
      p: () => flip("coverage"),
      z: () => { flip("zone"); flip("corridor"); },
      r: () => { this.from("free"); this.look(); this.touch(); },
      f: () => this.choose(this.flights[(this.flights.indexOf(this.flight) + 1) % this.flights.length]),
    }[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!does) return;
    event.preventDefault();
    if (event.target instanceof HTMLElement && event.target !== this.parts.canvas) event.target.blur();
    does();
  }

  // What is shown now, for scripts and tests.
  state() {
    const { flight } = this;
    return {
      time: this.transport.time,
      end: this.transport.end,
      playing: this.transport.playing,
      flight: flight.name,
      frame: this.frame,
      camera: this.eye.mode,
      chaser: flight.at.toArray(),
      eye: this.eye.camera.position.toArray(),
      attitude: flight.attitude.toArray(),
      shown: Object.fromEntries(Object.keys(this.show).map((name) => [name, this.show[name]])),
      surfaces: this.surfaces.map((mesh) => mesh.visible),
      flights: this.flights.filter((of) => of.shown).map((of) => of.name),
      growth: flight.grown && { stage: flight.grown.stage, view: flight.grown.view },
      coverage: flight.covered && { frame: flight.covered.frame, camera: flight.covered.cone.position.toArray(), boresight: flight.covered.boresight.toArray(), sun: flight.covered.sun.toArray() },
      standing: flight.rules?.bodies.filter(({ drawn }) => drawn.visible).map(({ name, drawn }) => ({ name, turned: drawn.quaternion.toArray() })),
      marks: flight.marks,
      frames: this.frames,
      calls: this.renderer.info.render.calls,
      triangles: this.renderer.info.render.triangles,
      software: this.software,
    };
  }
}

function tip(at, vector, radius) {
  const length = vector.length();
  return length > 0 ? at.clone().addScaledVector(vector, radius / length) : at;
}

// Up to so many of the points that an array holds.
function every(places, most) {
  const points = [];
  const stride = Math.max(1, Math.ceil(places.length / 3 / most));
  for (let at = 0; at < places.length; at += 3 * stride) points.push(new Vector3(places[at], places[at + 1], places[at + 2]));
  return points;
}

function softwareRendering() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (!context) throw new Error("this browser draws no WebGL 2");
  const told = context.getExtension("WEBGL_debug_renderer_info");
  const name = told ? context.getParameter(told.UNMASKED_RENDERER_WEBGL) : "";
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

const root = document.getElementById("replay");
read()
  .then((scene) => { globalThis.keepoutReplay = new Replay(root, scene); })
  .catch((error) => {
    root.replaceChildren(element("p", { class: "failed", role: "alert" }, `The replay cannot be shown: ${error.message}. What can be shown without it follows.`));
    root.classList.add("unshown");
    document.getElementById("figures").style.display = "block";
    console.error(error);
  });
