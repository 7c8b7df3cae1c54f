// Plots over time that share one cursor with the drawing: a click or a drag in them goes to that time.
import uPlot from "uplot";
import { MARKS } from "./colours.js";
import { percent } from "./coverage.js";
import { element, metres } from "./layout.js";

const QUIET = "#8791a3";
const GRID = "rgba(255,255,255,.06)";
const inUnit = (unit, digits) => (value) => (Number.isFinite(value) ? `${value.toFixed(digits)} ${unit}` : "–"); // that of the axis

const QUANTITIES = {
  clearance: { words: "Clearance, m", shown: metres, limits: () => [0], beside: "bound" },
  speed: { words: "Speed, m/s", shown: inUnit("m/s", 4), limits: (flight) => [flight.speed_limit], beside: "allowed" },
  force: { words: "Force, N", shown: inUnit("N", 4), limits: () => [0] },
  error: { words: "Distance to the goal, m", shown: metres, limits: (flight) => (flight.within ? [] : [flight.tolerance]), beside: "within", logarithmic: true },
  seen: { words: "Surface seen, %", shown: percent, limits: (flight) => [0, flight.coverage?.possible ?? 0], tick: (share) => String(Math.round(100 * share)) },
  barrier: { words: "Barrier h, m", shown: metres, limits: () => [0] },
};

export class Plots {
  constructor(root, flights, seek) {
    this.root = root;
    this.flights = flights;
    this.seek = seek;
    this.plots = {};
    for (const [name, of] of Object.entries(QUANTITIES)) {
      if (!flights.some((flight) => has(flight, name))) continue;
      const value = element("output", { "data-quantity": name });
      const place = element("div", { class: "place" });
      const panel = element("section", { class: "plot", "data-plot": name }, element("h2", {}, name === "error" && flights.some((flight) => flight.within) ? "Distance to the leg's place, m" : of.words, value), place);
      root.append(panel);
      this.plots[name] = { of, value, place };
    }
    new ResizeObserver(() => this.size()).observe(root);
  }

  // Draws the flights that are shown; the one in focus lies on top, with its proved bound, limits and marks.
  show(focus) {
    this.focus = focus;
    const shown = [...this.flights.filter((flight) => flight.shown && flight !== focus), focus];
    const last = Object.keys(this.plots).at(-1);
    for (const [name, plot] of Object.entries(this.plots)) {
      plot.drawn?.destroy();
      const lowest = plot.of.logarithmic ? 1e-4 : -Infinity;
      const tables = shown.map((flight) => [flight.time, Array.from(has(flight, name) ? flight[name] : flight.time.map(() => NaN), (value) => Number.isFinite(value) ? Math.max(value, lowest) : null)]);
      const series = shown.map((flight) => ({
        stroke: flight.colour, dash: flight.dashed ? [6, 3] : [], width: flight === focus ? 1.6 : 1, alpha: flight === focus ? 1 : 0.6, spanGaps: true, points: { show: false },
      }));
      const beside = focus[plot.of.beside]; // the proved bound, the speed allowed, the leg's tolerance
      if (beside) {
        tables.push([focus.time, Array.from(beside, (value) => (Number.isFinite(value) ? value : null))]);
        series.push({ stroke: "rgba(255,255,255,.75)", width: 1, dash: [2, 4], spanGaps: false, points: { show: false } });
      }
      const limits = plot.of.limits(focus);
      plot.drawn = new uPlot(this.options(name, plot, series, limits, name === last), uPlot.join(tables), plot.place);
      const now = element("div", { class: "now" });
      plot.drawn.over.append(now);
      plot.now = now;
      this.listen(plot.drawn);
    }
    this.size();
    this.move(this.time ?? 0);
  }

  options(name, plot, series, limits, last) {
    const axis = { stroke: QUIET, font: "10px system-ui, sans-serif", grid: { stroke: GRID, width: 1 }, ticks: { show: false } };
    const logarithmic = plot.of.logarithmic;
    return {
      width: 300,
      height: 90,
      legend: { show: false },
      cursor: { sync: { key: "keepout" }, drag: { x: false, y: false, setScale: false }, y: false, points: { size: 5 } },
      padding: [6, 20, last ? 0 : 4, 0],
      scales: {
        x: { time: false, range: (_, low, high) => [low, high] },
        y: logarithmic ? { distr: 3 } : { range: (_, low, high) => room(Math.min(low, ...limits), Math.max(high, ...limits)) },
      },
      axes: [
        { ...axis, size: last ? 20 : 0, gap: 2, values: last ? (_, ticks) => ticks.map((tick) => `${tick} s`) : () => [] },
        { ...axis, size: 40, gap: 3, space: 22, ...(logarithmic && { splits: (_, __, low, high) => decades(low, high), filter: (_, ticks) => ticks }), values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : plot.of.tick?.(tick) ?? label(tick, logarithmic))) },
      ],
      series: [{}, ...series],
      hooks: { drawClear: [(drawn) => this.underlay(drawn, limits)] },
    };
  }

  underlay(drawn, limits) {
    const { ctx, bbox } = drawn;
    ctx.save();
    for (const mark of this.focus.marks) {
      if (mark.kind === "nearest" || mark.kind === "reached") continue;
      const from = drawn.valToPos(mark.start, "x", true);
      const wide = mark.kind === "leg" ? 1 : Math.max(drawn.valToPos(mark.end, "x", true) - from, 1);
      ctx.fillStyle = `${MARKS[mark.kind]}${{ law: "18", guard: "2c", flag: "50", leg: "90" }[mark.kind]}`;
      ctx.fillRect(from, bbox.top, wide, bbox.height);
    }
    ctx.setLineDash([4, 4]);
    ctx.strokeStyle = "rgba(255,255,255,.35)";
    for (const limit of limits) {
      const at = drawn.valToPos(limit, "y", true);
      if (at < bbox.top || at > bbox.top + bbox.height) continue;
      ctx.beginPath();
      ctx.moveTo(bbox.left, at);
      ctx.lineTo(bbox.left + bbox.width, at);
      ctx.stroke();
    }
    ctx.restore();
  }

  listen(drawn) {
    const go = (event) => {
      const box = drawn.over.getBoundingClientRect();
      this.seek(drawn.posToVal(Math.min(Math.max(event.clientX - box.left, 0), box.width), "x"));
    };
    drawn.over.addEventListener("pointerdown", (event) => {
      drawn.over.setPointerCapture(event.pointerId);
      go(event);
    });
    drawn.over.addEventListener("pointermove", (event) => event.buttons === 1 && go(event));
  }

  size() {
    const names = Object.keys(this.plots);
    for (const name of names) {
      const { place, drawn } = this.plots[name];
      if (drawn && place.clientWidth > 0) drawn.setSize({ width: place.clientWidth, height: Math.max(place.clientHeight, 40) });
    }
    this.move(this.time ?? 0);
  }

  move(time) {
    this.time = time;
    const focus = this.focus;
    if (!focus) return;
    for (const [name, plot] of Object.entries(this.plots)) {
      if (!plot.drawn) continue;
      plot.now.style.transform = `translateX(${plot.drawn.valToPos(time, "x")}px)`;
      const value = focus.row === undefined || !has(focus, name) ? NaN : focus.number(focus[name], focus.row, focus.part);
      const bound = name === "clearance" ? focus.bound[Math.min(focus.row ?? 0, focus.rows - 2)] : NaN;
      plot.value.textContent = plot.of.shown(value) + (Number.isFinite(bound) ? `, proved ≥ ${metres(bound)}` : "");
    }
  }
}

// A flight that inspects has no goal, and others see no surface.
function has(flight, name) {
  return name === "seen" ? Boolean(flight.coverage) : name === "error" ? !flight.coverage : true;
}

// Powers of ten between two numbers, at most five.
function decades(low, high) {
  const [first, last] = [Math.ceil(Math.log10(low) - 1e-9), Math.floor(Math.log10(high) + 1e-9)];
  const stride = Math.max(1, Math.ceil((last - first) / 4));
  return Array.from({ length: Math.floor((last - first) / stride) + 1 }, (_, k) => 10 ** (first + k * stride));
}

function room(low, high) {
  const more = 0.08 * (high - low || Math.abs(high) || 1);
  return [low - more, high + more];
}

function label(tick, logarithmic) {
  if (logarithmic) return tick >= 1 ? String(tick) : tick.toPrecision(1).replace(/e-0?/, "e-");
  return String(Math.round(tick * 1e6) / 1e6);
}
