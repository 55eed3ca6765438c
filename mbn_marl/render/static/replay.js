// The player: episodes side by side on one clock, with buttons, a scrub bar and keys.

const SPEEDS = [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500]; // steps a second
const DURATION = 10; // seconds that the longest episode takes at first, about
const OUTCOMES = {
  success: ["\u2713", "success"],
  collision: ["\u2715", "collision"],
  truncated: ["\u25f7", "time limit"],
  unfinished: ["\u2026", "unfinished"],
};

/** An arrow the way the wind blows, with its speed; `show` makes it another's. */
function windArrow() {
  const arrow = svg("path", { d: "M-8 -1H2V-5L9 0L2 5V1H-8Z" });
  const ring = svg("circle", { r: 11 });
  const picture = svg("svg", { viewBox: "-12 -12 24 24", "aria-hidden": "true" }, ring, arrow);
  const text = html("span");
  const show = ([speed, angle]) => {
    arrow.setAttribute("transform", `rotate(${-angle})`);
    text.textContent = `wind ${shown(speed)} at ${shown(angle)}\u00b0`;
  };
  return { node: html("div", { class: "wind" }, text, picture), show };
}

class Panel {
  constructor(episode, colours, span) {
    this.episode = episode;
    this.stage = new Stage(episode, colours);
    this.chart = new Chart(episode, span);
    this.facts = ["step", "return", "ROIs"].map((name) => this.#fact(name));
    const [sign, word] = OUTCOMES[episode.outcome];
    const ending = `${sign} ${word}, ${episode.steps} step${episode.steps === 1 ? "" : "s"}`;
    const facts = html("dl", {}, ...this.facts.map(({ node }) => node));
    if (episode.winds || episode.wind[0] > 0) {
      this.wind = windArrow();
      facts.append(this.wind.node);
    }
    if (episode.knowledge) facts.append(this.#views());
    this.element = html(
      "section",
      { class: "panel" },
      html(
        "header",
        {},
        html("h2", {}, episode.source),
        html("span", { class: `outcome ${episode.outcome}` }, ending),
      ),
      facts,
      this.stage.element,
      this.chart.element,
    );
  }

  #fact(name) {
    const value = html("dd", { "data-fact": name });
    return { value, node: html("div", {}, html("dt", {}, name), value) };
  }

  /** Whose knowledge ROIs show, and whether lines show who tells whom. */
  #views() {
    const option = (robot) => html("option", { value: robot }, `as robot ${robot} knows`);
    const robots = Array.from({ length: this.episode.robots }, (_, robot) => option(robot));
    const truth = html("option", { value: "" }, "as they are");
    this.viewer = html("select", { "aria-label": "ROIs", title: "key R, or click a robot" }, truth, ...robots);
    this.switch = html("input", { type: "checkbox", checked: "" });
    for (const control of [this.viewer, this.switch]) {
      control.addEventListener("change", () => this.#look());
    }
    this.stage.element.classList.add("own");
    this.stage.element.addEventListener("click", ({ target }) => {
      const robot = target.closest(".robot")?.dataset.robot ?? "";
      this.viewer.value = robot === this.viewer.value ? "" : robot;
      this.#look();
    });
    const links = html("label", { title: "key T" }, this.switch, " who tells whom");
    return html("div", { class: "views" }, html("label", {}, "show ROIs ", this.viewer), links);
  }

  #look() {
    this.stage.viewer = this.viewer.value === "" ? null : Number(this.viewer.value);
    this.stage.linked = this.switch.checked;
    this.stage.show(this.stage.time);
  }

  /** Show the next robot's knowledge; after the last one's, the truth. */
  next() {
    if (!this.viewer) return;
    this.viewer.selectedIndex = (this.viewer.selectedIndex + 1) % this.viewer.length;
    this.#look();
  }

  show(time) {
    const { episode } = this;
    this.stage.show(time);
    this.chart.show(time);
    const step = episode.step(time);
    if (step === this.step) return;
    this.step = step;
    this.wind?.show(episode.windAfter(step));
    const rois = `${episode.visitedCount(step)}/${episode.roiCount}`;
    [`${step}`, shown(episode.returns[step]), rois].forEach((text, index) => {
      this.facts[index].value.textContent = text;
    });
  }
}

class Replay {
  constructor(root, files, colours) {
    const episodes = files.map((file) => new Episode(file));
    this.span = Math.max(...episodes.map((episode) => episode.steps));
    this.panels = episodes.map((episode) => new Panel(episode, colours, this.span));
    this.time = 0;
    this.playing = false;
    this.#controls();
    const panels = this.panels.map(({ element }) => element);
    root.replaceChildren(html("div", { class: "panels" }, ...panels), this.bar);
    this.seek(0);
  }

  /** Go to `time`, which is limited to the episodes' length. */
  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.span);
    for (const panel of this.panels) panel.show(this.time);
    this.scrub.value = this.time;
    const step = Math.floor(this.time);
    if (step !== this.step) {
      this.step = step;
      this.counter.textContent = `${step} / ${this.span}`;
      this.scrub.setAttribute("aria-valuetext", `step ${step} of ${this.span}`);
    }
  }

  /** Go `count` whole steps on, or back. */
  nudge(count) {
    this.play(false);
    this.seek(count > 0 ? Math.floor(this.time) + count : Math.ceil(this.time) + count);
  }

  /** Play or pause; at the end, playing begins again. */
  play(on = !this.playing) {
    if (on === this.playing) return;
    this.playing = on;
    this.button.textContent = on ? "\u275a\u275a" : "\u25b6";
    this.button.setAttribute("aria-label", on ? "pause" : "play");
    if (!on) return;
    if (this.time >= this.span) this.seek(0);
    let last;
    const frame = (now) => {
      if (!this.playing) return;
      if (last !== undefined) this.seek(this.time + ((now - last) / 1000) * Number(this.speed.value));
      last = now;
      if (this.time >= this.span) this.play(false);
      else requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  /** The next slower (-1) or faster (1) speed. */
  shift(by) {
    const index = this.speed.selectedIndex + by;
    this.speed.selectedIndex = Math.min(Math.max(index, 0), SPEEDS.length - 1);
  }

  /** Answer a key; says whether it was one of the player's. */
  press(key, far) {
    const stride = far ? 10 : 1;
    const actions = {
      " ": () => this.play(),
      k: () => this.play(),
      ArrowRight: () => this.nudge(stride),
      ArrowLeft: () => this.nudge(-stride),
      Home: () => this.seek(0),
      End: () => this.seek(this.span),
      "+": () => this.shift(1),
      "-": () => this.shift(-1),
      r: () => this.panels.forEach((panel) => panel.next()),
      t: () => this.panels.forEach((panel) => panel.switch?.click()),
    };
    actions[key]?.();
    return key in actions;
  }

  #controls() {
    const button = (sign, label, act) => {
      const made = html("button", { type: "button", "aria-label": label }, sign);
      made.addEventListener("click", act);
      return made;
    };
    this.button = button("\u25b6", "play", () => this.play());
    this.button.classList.add("play");
    this.scrub = html("input", {
      type: "range", min: 0, max: this.span, step: "any", "aria-label": "step", class: "scrub",
    });
    this.scrub.addEventListener("input", () => {
      this.play(false);
      this.seek(Math.round(Number(this.scrub.value)));
    });
    this.counter = html("output", { class: "counter" });
    const first = SPEEDS.find((speed) => this.span / speed <= DURATION) ?? SPEEDS.at(-1);
    this.speed = html(
      "select",
      { "aria-label": "speed" },
      ...SPEEDS.map((speed) => html("option", { value: speed }, `${speed} steps/s`)),
    );
    this.speed.value = first;
    this.bar = html(
      "div",
      { class: "controls", role: "group", "aria-label": "player" },
      this.button,
      button("\u2039", "one step back", () => this.nudge(-1)),
      button("\u203a", "one step on", () => this.nudge(1)),
      this.scrub,
      this.counter,
      this.speed,
    );
  }
}

// Every replay of the page. Keys go to the one that was last touched; before that, and after a touch
// beside them all, to the one that is marked with data-keys, or to none.
const colours = Number(document.documentElement.dataset.colours);
const replays = [...document.querySelectorAll("[data-replay]")].map((root) => {
  const files = JSON.parse(document.getElementById(root.dataset.replay).textContent);
  return { root, replay: new Replay(root, files, colours) };
});
const first = replays.find(({ root }) => "keys" in root.dataset);
let current = first;
for (const kind of ["pointerdown", "focusin"]) {
  document.addEventListener(kind, (event) => {
    current = replays.find(({ root }) => root.contains(event.target)) ?? first;
  });
}
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || !current) return;
  const on = event.target.tagName;
  const pressed = event.key === " " && event.target.matches("button, [type=checkbox]");
  if (on === "SELECT" || pressed) return;
  if (current.replay.press(event.key, event.shiftKey)) event.preventDefault();
});
