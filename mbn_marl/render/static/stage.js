// The field of one episode: ground, trails, ROIs, links, robots and the names of ROIs, from bottom to
// top.
// The ground and what moves are SVG; trails, which only grow, are drawn on a canvas between them.

const BORDER = 0.05; // round the field, as a share of its larger side
const ROBOT = 9; // pixels
const CROSS = `M${-ROBOT} ${-ROBOT}L${ROBOT} ${ROBOT}M${-ROBOT} ${ROBOT}L${ROBOT} ${-ROBOT}`;
const MARKER = 6; // of an ROI, pixels
const DOTTED = 150; // trails of episodes up to this many steps have a dot at every step

class Stage {
  constructor(episode, colours) {
    this.episode = episode;
    this.colours = colours;
    this.#frame();
    this.trails = html("canvas");
    this.rois = episode.field.rois.map((place) => this.#roi(place));
    this.links = svg("path", { class: "links" });
    this.tips = this.#robots((index) => svg("line", { class: "tip", stroke: this.#colour(index) }));
    this.noses = this.#robots((index) => this.#nose(index));
    this.bodies = this.#robots((index) => this.#robot(index));
    this.names = episode.field.rois.map((place, index) => this.#name(place, index));
    const view = `0 0 ${this.width} ${this.height}`;
    this.element = html(
      "div",
      { class: "stage", style: `aspect-ratio: ${this.width} / ${this.height}` },
      svg("svg", { viewBox: view }, this.#ground()),
      this.trails,
      svg("svg", { viewBox: view }, ...this.rois, this.links, ...this.tips, ...this.bodies, ...this.names),
    );
    this.time = 0;
    this.viewer = null; // the robot whose knowledge ROIs show
    this.linked = true;
    new ResizeObserver(() => this.#resize()).observe(this.element);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#redraw());
  }

  /** Show the episode at `time`. */
  show(time) {
    this.time = time;
    const { episode } = this;
    this.rois.forEach((roi, index) => {
      for (const [name, on] of Object.entries(episode.look(index, time, this.viewer))) {
        roi.classList.toggle(name, on);
        this.names[index].classList.toggle(name, on);
      }
    });
    const step = episode.step(time);
    this.#trailTo(step);
    this.bodies.forEach((body, robot) => {
      const [x, y] = this.#seen(...episode.position(robot, time));
      body.setAttribute("transform", `translate(${x} ${y})`);
      const turn = (-180 / Math.PI) * episode.heading(robot, time);
      if (!Number.isNaN(turn)) this.noses[robot].setAttribute("transform", `rotate(${turn})`);
      body.classList.toggle("failed", episode.hasFailed(robot, time));
      body.classList.toggle("viewer", robot === this.viewer);
      const [fromX, fromY] = this.#seen(...episode.position(robot, step));
      fill(this.tips[robot], { x1: fromX, y1: fromY, x2: x, y2: y }, []);
    });
    if (episode.knowledge) this.links.setAttribute("d", this.linked ? this.#linksAt(time) : "");
  }

  /** From each robot half of the way to each one that it hears: a whole line if both hear. */
  #linksAt(time) {
    const places = this.#robots((robot) => this.#seen(...this.episode.position(robot, time)));
    const half = ([x, y], [toX, toY]) => `M${x} ${y}L${(x + toX) / 2} ${(y + toY) / 2}`;
    const heard = (robot, other) => this.episode.hears(robot, other, this.episode.step(time));
    return places
      .flatMap((place, robot) => places.filter((_, other) => heard(robot, other)).map((to) => half(place, to)))
      .join("");
  }

  /** What part of the plane is seen: the field with a border, y up. */
  #frame() {
    const axis = (k) => this.episode.field.vertices.map((corner) => corner[k]);
    const low = [0, 1].map((k) => Math.min(...axis(k)));
    const high = [0, 1].map((k) => Math.max(...axis(k)));
    const border = BORDER * Math.max(high[0] - low[0], high[1] - low[1]);
    [this.left, this.top] = [low[0] - border, high[1] + border];
    this.width = high[0] - low[0] + 2 * border;
    this.height = high[1] - low[1] + 2 * border;
  }

  /** A place in units as one of the picture. */
  #seen(x, y) {
    return [x - this.left, this.top - y];
  }

  #colour(robot) {
    return `var(--robot-${robot % this.colours})`;
  }

  #robots(make) {
    return Array.from({ length: this.episode.robots }, (_, index) => make(index));
  }

  #ground() {
    const { vertices, holes } = this.episode.field;
    const ring = (corners) => `M${corners.map((corner) => this.#seen(...corner).join(" ")).join("L")}Z`;
    const d = [vertices, ...holes].map(ring).join("");
    return svg("path", { class: "ground", d, "fill-rule": "evenodd" });
  }

  #roi(place) {
    const marker = svg(
      "g",
      { class: "pixels" },
      svg("circle", { class: "marker", r: MARKER }),
      svg("path", { class: "tick", d: "M-2.7 0.1L-0.7 2.2L2.9 -2" }),
      svg("path", { class: "void", d: "M-4.2 -4.2L4.2 4.2" }),
    );
    const reach = svg("circle", { class: "reach", r: this.episode.roiRadius });
    return this.#at(place, "roi", reach, marker);
  }

  #name(place, index) {
    const text = svg("text", { class: "name", x: MARKER + 2, y: -MARKER }, `${index + 1}`);
    return this.#at(place, "label", svg("g", { class: "pixels" }, text));
  }

  /** What is drawn at a place that does not move. */
  #at(place, kind, ...children) {
    const [x, y] = this.#seen(...place);
    return svg("g", { class: kind, transform: `translate(${x} ${y})` }, ...children);
  }

  /** A point that sticks out of a robot's disc the way that it faces, if it has a heading. */
  #nose(index) {
    if (Number.isNaN(this.episode.heading(index, 0))) return svg("g");
    const d = `M${ROBOT + 7} 0L${ROBOT - 3} ${-ROBOT * 0.7}L${ROBOT - 3} ${ROBOT * 0.7}Z`;
    return svg("path", { class: "nose", fill: this.#colour(index), d });
  }

  #robot(index) {
    const colour = this.#colour(index);
    const disc = svg(
      "g",
      { class: "pixels" },
      this.noses[index],
      svg("circle", { class: "disc", r: ROBOT, fill: colour }),
      svg("text", { fill: `var(--ink-on-robot-${index % this.colours})` }, `${index}`),
      svg("path", { class: "cross", d: CROSS }),
    );
    const safety = svg("circle", {
      class: "safety",
      r: this.episode.safetyDistance / 2,
      fill: colour,
      stroke: colour,
    });
    return svg("g", { class: "robot", "data-robot": index }, safety, disc);
  }

  /** Fit markers and canvas, which are measured in pixels, to the element's size. */
  #resize() {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (width === 0) return;
    const unit = this.width / width;
    for (const node of this.element.querySelectorAll(".pixels")) {
      node.setAttribute("transform", `scale(${unit})`);
    }
    const density = window.devicePixelRatio || 1;
    this.trails.width = Math.round(width * density);
    this.trails.height = Math.round(height * density);
    this.scale = this.trails.width / this.width;
    this.density = density;
    this.#redraw();
  }

  #redraw() {
    this.drawn = undefined;
    this.show(this.time);
  }

  /** Draw trails up to a step: only what is new, or all after a step back. */
  #trailTo(step) {
    if (this.scale === undefined || step === this.drawn) return;
    const pen = this.trails.getContext("2d");
    let from = this.drawn;
    if (from === undefined || step < from) {
      pen.clearRect(0, 0, this.trails.width, this.trails.height);
      from = 0;
    }
    const styles = getComputedStyle(this.element);
    const dots = this.episode.steps <= DOTTED;
    pen.lineWidth = 1.5 * this.density;
    pen.lineJoin = "round";
    for (let robot = 0; robot < this.episode.robots; robot += 1) {
      const colour = styles.getPropertyValue(`--robot-${robot % this.colours}`);
      pen.strokeStyle = colour;
      pen.fillStyle = colour;
      this.#trail(pen, robot, from, step, dots);
    }
    this.drawn = step;
  }

  #trail(pen, robot, from, to, dots) {
    const at = (step) =>
      this.#seen(...this.episode.position(robot, step)).map((place) => place * this.scale);
    const line = new Path2D();
    line.moveTo(...at(from));
    for (let step = from + 1; step <= to; step += 1) line.lineTo(...at(step));
    pen.stroke(line);
    if (!dots) return;
    for (let step = from; step <= to; step += 1) {
      pen.beginPath();
      pen.arc(...at(step), (step === 0 ? 4 : 2.4) * this.density, 0, 2 * Math.PI);
      pen.fill();
    }
  }
}
