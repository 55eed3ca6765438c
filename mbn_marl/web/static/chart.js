// The rewards of one episode by term: a row each, its running total against time, and a cursor.

const MOST_POINTS = 1500; // of a line; longer episodes are thinned out

class Chart {
  /** `span`: how many steps the time axis has. */
  constructor(episode, span) {
    this.episode = episode;
    this.span = span;
    const total = { name: "return", totals: episode.returns, kind: "total" };
    const terms = episode.terms.map((term) => ({ ...term, kind: kindOf(term.totals) }));
    this.rows = [total, ...terms].map((term) => this.#row(term));
    this.cursor = html("div", { class: "cursor" });
    this.element = html(
      "div",
      { class: "chart", role: "img", "aria-label": "running totals of the reward by term" },
      ...this.rows.map(({ node }) => node),
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
    const lines = svg(
      "svg",
      { viewBox: `0 -0.08 ${Math.max(this.span, 1)} 1.16`, preserveAspectRatio: "none" },
      svg("path", { d: outline(sums) }),
    );
    const node = html("div", { class: `term ${kind}` }, html("span", {}, name), lines, output);
    return { node, output, totals: sums };
  }
}

function kindOf(sums) {
  return sums[sums.length - 1] < 0 ? "cost" : "gain";
}

/** Running totals as the path of a staircase, between 0 (bottom) and 1. */
function outline(sums) {
  const [low, high] = sums.reduce(
    ([least, most], value) => [Math.min(least, value), Math.max(most, value)],
    [0, 0],
  );
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
