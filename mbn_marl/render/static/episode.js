// An episode in the format mbn-episode/1 (see docs/replay.md), ready to be looked at at any time.
// Time is counted in steps and may lie between two of them.

const ARRAYS = {
  float32: Float32Array,
  float64: Float64Array,
  uint8: Uint8Array,
  uint16: Uint16Array,
};

/** The numbers of a packed array, flat. */
function unpack({ dtype, data }) {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  return new ARRAYS[dtype](bytes.buffer);
}

/** The numbers of a coded array, flat. */
function decode({ values, indices }) {
  return Float64Array.from(unpack(indices), (index) => values[index]);
}

/** Running totals of `step(t)`, before the first step and after every one. */
function totals(steps, step) {
  const sums = new Float64Array(steps + 1);
  for (let t = 0; t < steps; t += 1) sums[t + 1] = sums[t] + step(t);
  return sums;
}

class Episode {
  constructor(file) {
    const { config, drawn, knowledge, headings, winds } = file;
    const numbers = { ...config, ...drawn };
    Object.assign(this, file, {
      source: file.source || "episode",
      roiRadius: numbers.roi_radius,
      safetyDistance: numbers.safety_distance,
      places: unpack(file.positions),
      knowledge: knowledge && { ...knowledge, heard: unpack(knowledge.heard) },
      headings: headings && unpack(headings),
      winds: winds && unpack(winds),
    });
    const team = decode(file.rewards.team);
    this.returns = totals(this.steps, (t) => team[t]);
    this.terms = this.#termTotals(file.rewards);
  }

  /** For each term that ever counted, its name and the team's running totals. */
  #termTotals({ terms, robots }) {
    const earned = decode(robots);
    const width = terms.length;
    const sum = (t, term) => {
      let value = 0;
      for (let robot = 0; robot < this.robots; robot += 1) {
        value += earned[(t * this.robots + robot) * width + term];
      }
      return value;
    };
    return terms
      .map((name, term) => ({ name, totals: totals(this.steps, (t) => sum(t, term)) }))
      .filter(({ totals: sums }) => sums.some((value) => value !== 0));
  }

  /** Where a robot is: [x, y] in units; between two steps it moves evenly. */
  position(robot, time) {
    const before = Math.floor(Math.min(time, this.steps));
    const share = Math.min(time, this.steps) - before;
    const at = 2 * (before * this.robots + robot);
    const next = share > 0 ? at + 2 * this.robots : at;
    return [0, 1].map((axis) => {
      const place = this.places[at + axis];
      return place + share * (this.places[next + axis] - place);
    });
  }

  /** Which way a robot faces after the last whole step, radians from +x; NaN if it has no heading. */
  heading(robot, time) {
    return this.headings ? this.headings[this.step(time) * this.robots + robot] : NaN;
  }

  /** The last whole step at `time`. */
  step(time) {
    return Math.floor(Math.min(time, this.steps));
  }

  /** The wind in the step after `step`, with its gust: speed, and degrees from +x. */
  windAfter(step) {
    if (!this.winds) return this.wind;
    const [x, y] = this.winds.subarray(2 * step, 2 * step + 2);
    return [Math.hypot(x, y), Math.round((180 / Math.PI) * Math.atan2(y, x))];
  }

  isVisited(roi, time) {
    return (this.visits[roi] ?? Infinity) <= time;
  }

  /** How an ROI looks at `time`: to a robot that knows only its own, or, to none, as it is. */
  look(roi, time, robot = null) {
    const { knowledge } = this;
    if (robot === null) {
      const empty = knowledge?.empty[roi] ?? false;
      return { visited: this.isVisited(roi, time), empty, unfound: false };
    }
    const step = this.step(time);
    const visited = knowledge.done[robot][roi] <= step;
    return { visited, empty: false, unfound: !visited && knowledge.found[robot][roi] > step };
  }

  /** Whether a robot received words of another one in a step: a bit of a row of bytes. */
  hears(robot, other, step) {
    const row = Math.ceil(this.robots ** 2 / 8);
    const bit = robot * this.robots + other;
    return ((this.knowledge.heard[step * row + (bit >> 3)] >> (7 - (bit & 7))) & 1) === 1;
  }

  hasFailed(robot, time) {
    return (this.failed?.[robot] ?? Infinity) <= time;
  }

  visitedCount(time) {
    return this.visits.filter((_, roi) => this.isVisited(roi, time)).length;
  }

  /** How many ROIs are not empty. */
  get roiCount() {
    return this.visits.length - (this.knowledge?.empty.filter(Boolean).length ?? 0);
  }
}
