// Time: play, speed, step, the slider, and the marks above it.
import { MARKS } from "./colours.js";
import { element } from "./layout.js";

const RATES = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 6000, 36000];
const WHOLE_FLIGHT = 25; // s: about what a flight takes at the speed it starts with

export class Transport {
  constructor(root, flights, changed) {
    this.changed = changed;
    this.end = Math.max(...flights.map((flight) => flight.length));
    this.time = 0;
    this.playing = false;
    this.rate = RATES.find((rate) => this.end / rate <= WHOLE_FLIGHT) ?? RATES.at(-1);
    const button = (name, words, title, pressed) => element("button", { name, title, "aria-label": title, onclick: pressed }, words);
    this.play = button("play", "▶", "Play or pause (space)", () => this.toggle());
    this.slider = element("input", { type: "range", min: "0", max: String(this.end), step: "any", value: "0", "aria-label": "Time, s" });
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    this.speeds = element("select", { name: "speed", title: "Speed (− and +)", "aria-label": "Speed" },
      ...RATES.map((rate) => element("option", { value: String(rate) }, `${rate} ×`)));
    this.speeds.value = String(this.rate);
    this.speeds.addEventListener("change", () => this.faster(Number(this.speeds.value)));
    this.clock = element("output", { class: "clock" });
    this.marks = element("div", { class: "marks", role: "group", "aria-label": "Marks" });
    this.words = element("p", { class: "words" });
    root.append(
      element("div", { class: "buttons" },
        button("start", "▏◀", "To the start (Home)", () => this.seek(0)),
        button("back", "‹ step", "A step back (←)", () => this.step(-1)),
        this.play,
        button("forward", "step ›", "A step forward (→)", () => this.step(1)),
        this.speeds,
        button("previous", "‹ mark", "To the mark before ([)", () => this.jump(-1)),
        button("next", "mark ›", "To the next mark (])", () => this.jump(1)),
        this.clock, this.words),
      element("div", { class: "track" }, this.marks, this.slider)
    );
  }

  focus(flight) {
    this.flight = flight;
    this.marks.classList.toggle("legs", flight.marks.some((mark) => mark.kind === "leg"));
    this.marks.replaceChildren(...flight.marks.map((mark) => {
      const left = (100 * mark.start) / this.end;
      const wide = (100 * (mark.end - mark.start)) / this.end;
      const title = said(mark);
      return element("button", {
        class: `mark ${mark.kind}`, title, "aria-label": title, "data-start": mark.start,
        style: `left:${left}%;width:${wide}%;background:${MARKS[mark.kind]}`, onclick: () => this.to(mark),
      }, mark.kind === "leg" ? mark.words : "");
    }));
  }

  to(mark) {
    this.pause();
    this.seek(mark.start);
    this.words.textContent = said(mark);
  }

  jump(way) {
    const starts = way > 0
      ? this.flight.marks.find((mark) => mark.start > this.time + 1e-6)
      : this.flight.marks.findLast((mark) => mark.start < this.time - 1e-6);
    if (starts) this.to(starts);
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.end);
    this.slider.value = String(this.time);
    this.clock.textContent = `${this.time.toFixed(1)} s of ${this.end.toFixed(0)} s`;
    this.words.textContent = "";
    this.changed();
  }

  step(rows) {
    this.pause();
    const times = this.flight.time;
    const row = times.findIndex((time) => time > this.time + 1e-6);
    const here = row === -1 ? times.length - 1 : row - 1;
    const between = this.time > times[here] + 1e-6;
    const to = rows < 0 && between ? here + rows + 1 : here + rows;
    this.seek(times[Math.min(Math.max(to, 0), times.length - 1)]);
  }

  faster(rate) {
    this.rate = rate;
    this.speeds.value = String(rate);
  }

  next(way) {
    const at = RATES.indexOf(this.rate) + way;
    if (RATES[at]) this.faster(RATES[at]);
  }

  toggle() {
    if (this.playing) return this.pause();
    if (this.time >= this.end) this.seek(0);
    this.playing = true;
    this.play.textContent = "❚❚";
    this.changed();
  }

  pause() {
    this.playing = false;
    this.play.textContent = "▶";
  }

  // Goes on by so many seconds of the clock on the wall.
  pass(seconds) {
    if (!this.playing) return;
    this.seek(this.time + seconds * this.rate);
    if (this.time >= this.end) this.pause();
  }
}

function said(mark) {
  const when = mark.end > mark.start ? `${mark.start.toFixed(1)} s to ${mark.end.toFixed(1)} s` : `${mark.start.toFixed(1)} s`;
  return `${mark.words}${mark.times > 1 ? `, ${mark.times} times` : ""}: ${when}`;
}
