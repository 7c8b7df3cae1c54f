// Colours that people with any kind of colour vision tell apart, on a dark ground.

export const FLIGHTS = ["#56b4e9", "#e69f00", "#2fc79a", "#f0e442", "#e08fc0", "#f2743c", "#ffffff"];
export const ENVELOPE = "#4fa8e0";
export const GUARD = "#f0c04a";
export const THRUST = "#ff9d3c";
export const SAFE_VELOCITY = "#7fd4ff";
export const CLOSEST = "#ff8fd0";
export const SUN = "#ffe9a8";
export const MAP = "#b79cf0";
export const VIEW = "#ffd166";
export const ZONE = "#ff6b6b";
export const CORRIDOR = "#7ee8c4";
export const LEG = "#d4c2ff";
export const REFUSED = "#ff5d5d";
export const GOAL = "#3ddc97";
export const START = "#e8ecf2";
export const MARKS = { guard: "#e69f00", flag: "#ff6b3d", law: "#7d889c", nearest: "#f0e442", reached: "#3ddc97", leg: LEG };

// Plasma (matplotlib, CC0) from its purple to its yellow: near is bright, far is dark.
const STOPS = ["#f0f921", "#fcce25", "#fca636", "#f2844b", "#e16462", "#cc4778", "#b12a90", "#8f2fb8", "#6a4bd0", "#5566d8"].map(parse);

function parse(colour) {
  return [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16) / 255);
}

// Colour (0 to 1, sRGB) of a share from 0, near, to 1, far.
export function ramp(share) {
  const place = Math.min(Math.max(share, 0), 1) * (STOPS.length - 1);
  const first = Math.min(Math.floor(place), STOPS.length - 2);
  return STOPS[first].map((from, k) => from + (STOPS[first + 1][k] - from) * (place - first));
}

// Clearances are shown on a square root: what is near takes most of the colours.
export class Scale {
  constructor(flights) {
    const all = flights.flatMap((flight) => Array.from(flight.clearance)).sort((a, b) => a - b);
    this.least = Math.min(0, all[0]);
    const most = all[Math.floor(0.98 * (all.length - 1))];
    this.most = Math.max(most, this.least + 0.1);
  }

  share(clearance) {
    return Math.sqrt(Math.min(Math.max((clearance - this.least) / (this.most - this.least), 0), 1));
  }

  colour(clearance) {
    return ramp(this.share(clearance));
  }

  ticks() {
    const steps = [0, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
    const chosen = [];
    for (const step of steps) {
      if (step < this.least || step > this.most) continue;
      if (chosen.length === 0 || this.share(step) - this.share(chosen[chosen.length - 1]) > 0.13) chosen.push(step);
    }
    return chosen;
  }
}
