// The rewards of one episode by term: a row each, its running total against steps, and a cursor.
// Beside each row is the scale of its axis, in reward units, and below all is the axis of the steps.

const MOST_POINTS = 1500; // of a line; longer episodes are thinned out

class Chart {
  /** `span`: how many steps the time axis has. */
  constructor(episode, span) {
    this.episode = episode;
    this.span = span;
    const total = { name: "return", totals: episode.returns, kind: "total" };
    const kind = (sums) => (sums.at(-1) < 0 ? "cost" : "gain");
    const terms = episode.terms.map((term) => ({ ...term, kind: kind(term.totals) }));
    this.rows = [total, ...terms].map((term) => this.#row(term));
    this.cursor = html("div", { class: "cursor" });
    this.element = html(
      "div",
      { class: "chart", role: "img", "aria-label": "running totals of the reward by term" },
      html("div", { class: "term heading" }, html("span", {}, "running total of the reward")),
      ...this.rows.map(({ node }) => node),
      this.#steps(),
      html("div", { class: "track" }, this.cursor),
    );
  }

  show(time) {
    const share = this.span === 0 ? 0 : Math.min(time, this.episode.steps) / this.span;
    this.cursor.style.transform = `translateX(${100 * share}%)`;
    const step = this.episode.step(time);
    if (step === this.step) return;
    this.step = step;
    for (const { output, totals: sums } of this.rows) output.textContent = shown(sums[step]);
  }

  #row({ name, totals: sums, kind }) {
    const output = html("output");
    const range = rangeOf(sums);
    const lines = svg(
      "svg",
      { viewBox: `0 -0.08 ${Math.max(this.span, 1)} 1.16`, preserveAspectRatio: "none" },
      svg("path", { d: outline(sums, range) }),
    );
    const [low, high] = range.map((value) => html("span", {}, brief(value)));
    const scale = html("span", { class: "scale" }, high, low);
    const label = html("span", { class: "label" }, name);
    const node = html("div", { class: `term ${kind}` }, label, scale, lines, output);
    return { node, output, totals: sums };
  }

  /** The axis of the steps: round numbers up to the end. */
  #steps() {
    const stride = roundStride(this.span / 4);
    const count = stride > 0 ? Math.floor(this.span / stride) : 0;
    const ticks = Array.from({ length: count + 1 }, (_, index) => {
      const left = this.span === 0 ? 0 : (100 * index * stride) / this.span;
      return html("span", { style: `left: ${left}%` }, shown(index * stride));
    });
    const axis = html("div", { class: "ticks" }, ...ticks);
    return html("div", { class: "term steps" }, axis, html("span", { class: "unit" }, "steps"));
  }
}

/** The least and the greatest of some running totals and 0. */
function rangeOf(sums) {
  return sums.reduce(
    ([least, most], value) => [Math.min(least, value), Math.max(most, value)],
    [0, 0],
  );
}

/** The largest of 1, 2, 5, 10, 20 ... that is not above `most`; 1 at least. */
function roundStride(most) {
  const decade = 10 ** Math.floor(Math.log10(Math.max(most, 1)));
  return [5, 2, 1].map((factor) => factor * decade).find((stride) => stride <= Math.max(most, 1));
}

/** Running totals as the path of a staircase, between 0 (bottom) and 1. */
function outline(sums, [low, high]) {
  const place = (value) => (high === low ? 0.5 : 1 - (value - low) / (high - low)).toFixed(4);
  const stride = Math.ceil(sums.length / MOST_POINTS);
  let path = `M0 ${place(sums[0])}`;
  let last = place(sums[0]);
  for (let t = stride; t < sums.length; t += stride) {
    const here = place(sums[t]);
    if (here !== last) path += `H${t}V${here}`;
    last = here;
  }
  return `${path}H${sums.length - 1}V${place(sums[sums.length - 1])}`;
}
