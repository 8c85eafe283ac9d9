// The clock and the controls: plays people from the two elements #meta (JSON) and #data (base64).

const HEAD_HIGH = 2.3; // metres, where a take's label is
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const ZOOMS = { "+": 0.87, "=": 0.87, "-": 1.15, "_": 1.15 };
const MOMENTS = 21; // at which is measured how much room people take
const WAKES = ["input", "change", "click", "keydown", "pointerdown", "pointermove", "pointerup", "wheel"];

class Player {
  constructor({ meta, arrays }) {
    this.meta = meta;
    this.time = 0;
    this.speed = 1;
    this.playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.loop = true;
    this.drawn = 0;
    this.seen = true;
    const canvas = document.getElementById("canvas");
    this.motion = new Motion(meta, arrays);
    this.picture = new Picture(canvas, meta, arrays);
    this.view = new View(canvas, meta, arrays);
    this.labels = meta.takes.map(() => document.getElementById("labels").appendChild(document.createElement("div")));
    this.controls();
    this.choose(ALL);
    const middles = this.labels.map((_, take) => this.centre(this.view.shown.filter((person) => person.take === take)));
    this.apart = Math.min(...middles.slice(1).map((middle, take) => middle[0] - middles[take][0])); // metres
    this.wakeful();
  }

  // What may change the picture, whoever's event it is.
  wakeful() {
    for (const name of WAKES) document.addEventListener(name, () => this.wake(), { capture: true, passive: true });
    DARK.addEventListener("change", () => this.theme());
    new ResizeObserver(() => this.wake()).observe(this.picture.canvas);
    this.theme();
    this.wake();
  }

  // Play, or draw what has changed, and then rest: a page that stands still asks nothing of the processor.
  wake() {
    if (this.awake) return;
    this.awake = true;
    let last = performance.now();
    const tick = (now) => {
      const moved = this.seen && this.advance(Math.max(0, now - last) / 1000); // the first one may lie before `last`
      last = now;
      this.awake = moved || (this.seen && this.playing);
      if (this.awake) requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  // Dress for a light page or a dark one, at once: a page that is printed is not drawn again by and by.
  theme() {
    const { picture, view } = this;
    picture.theme(DARK.matches);
    document.getElementById("givens").replaceChildren();
    if (view.anyGiven) this.entry("givens", `${picture.faint}: given`, this.faint());
    this.ribbon();
    this.advance(0);
  }

  // The inks of given motion, side by side.
  faint() {
    const inks = this.view.people.filter((person) => !person.ghost).map((person) => `rgb(${person[this.picture.faint]})`);
    return `linear-gradient(90deg, ${inks[0]} 50%, ${inks[1] ?? inks[0]} 50%)`;
  }

  get frame() {
    return Math.min(Math.floor(this.time), this.meta.frames - 1);
  }

  centre(people = this.view.shown) {
    const roots = people.map((person) => this.motion.root(person.index, this.time));
    return [0, 1, 2].map((k) => roots.reduce((sum, root) => sum + root[k], 0) / roots.length);
  }

  // Look at one take or at all, from as far away as these people need for most of the time.
  choose(take) {
    const { view, motion, meta } = this;
    view.choose(take);
    const widths = Array.from({ length: MOMENTS }, (_, i) => {
      const roots = view.shown.map(({ index }) => motion.root(index, (i / (MOMENTS - 1)) * (meta.frames - 1)));
      const along = [0, 2].map((k) => roots.map((root) => root[k]));
      return Math.max(...along.map((places) => Math.max(...places) - Math.min(...places)));
    });
    widths.sort((a, b) => a - b);
    [this.half, this.widest] = [0.8, 1].map((share) => widths[Math.floor(share * (MOMENTS - 1))] / 2 + 0.7);
    view.distance = this.needed = this.far();
    view.goTo(this.centre(), 1);
    this.ribbon();
  }

  // Metres from which the people fill the picture, and from which a narrow one, such as a phone's, holds all of them.
  far() {
    const { clientWidth, clientHeight } = this.picture.canvas;
    const aspect = clientWidth / clientHeight || 1; // a folded frame has no size
    const feet = 1.1 + 1.92 * this.half; // of the nearest of a circle, from three quarters
    return Math.min(Math.max(3.6, 2.2 * this.half, feet, this.widest / (Math.tan(FIELD / 2) * aspect)), FARTHEST);
  }

  // As near or far as somebody has zoomed, in a window of another shape.
  resized() {
    const before = this.needed;
    this.needed = this.far();
    this.view.zoom(this.needed / before);
  }

  ribbon() {
    const { style } = document.getElementById("time");
    [style.background, style.height] = this.view.ribbon(this.meta.frames, this.picture.marks, this.picture.faint);
  }

  // Let time pass, and draw if that, or anything since, changes what is seen. -> whether it did
  advance(seconds) {
    const { meta, view } = this;
    if (this.playing) {
      this.time += seconds * meta.fps * this.speed;
      if (this.time >= meta.frames) {
        if (this.loop) this.time %= meta.frames; // the last frame is seen as long as the others
        else {
          this.time = meta.frames - 1;
          this.play(false);
        }
      }
    }
    if (view.follow) view.goTo(this.centre(), Math.min(1, 4 * seconds));
    const look = this.look();
    if (look === this.looked) return false;
    this.looked = look;
    this.picture.draw(this.motion, this.time, view);
    this.drawn += 1;
    this.show();
    return true;
  }

  // All that the picture depends on, in one line; a place to a tenth of a millimetre, so that the camera arrives.
  look() {
    const { view, picture } = this;
    const { clientWidth, clientHeight } = picture.canvas;
    const place = view.target.map((x) => x.toFixed(4));
    const angles = [view.azimuth, view.elevation, view.distance];
    const chosen = [view.take, view.style, view.ghosts, view.marks, picture.faint, this.playing, this.time];
    return [...place, ...angles, ...chosen, clientWidth, clientHeight, window.devicePixelRatio].join();
  }

  play(on) {
    if (on && this.frame >= this.meta.frames - 1) this.time = 0;
    this.playing = on;
    this.wake();
  }

  seek(frame) {
    this.playing = false;
    this.time = Math.min(Math.max(frame, 0), this.meta.frames - 1);
    this.wake();
  }

  show() {
    const { meta, frame } = this;
    const get = (id) => document.getElementById(id);
    get("play").textContent = this.playing ? "Pause" : "Play";
    get("time").value = frame;
    get("clock").textContent = `${(frame / meta.fps).toFixed(2)} s of ${(meta.frames / meta.fps).toFixed(1)} s`;
    const alone = meta.takes.length === 1 || this.view.take !== ALL;
    get("state").textContent = alone ? this.said(this.view.shown, this.view.take) : "";
    get("time").ariaValueText = [get("clock").textContent, get("state").textContent].filter((text) => text).join(", ");
    for (const [take, label] of this.labels.entries()) {
      const people = alone ? [] : this.view.shown.filter((person) => person.take === take);
      const place = people.length && this.overhead(people);
      label.hidden = !place;
      if (!place) continue;
      label.style.maxWidth = `clamp(12ch, ${this.gap()}px, 24ch)`; // beside its neighbours, but whole words
      label.textContent = [meta.takes[take], this.said(people, take)].filter((text) => text).join(": ");
      const { offsetWidth: wide, offsetHeight: tall } = label;
      const right = this.picture.canvas.clientWidth - wide / 2;
      label.style.left = `${Math.max(Math.min(place[0], right), wide / 2)}px`;
      label.style.top = `${Math.max(place[1], tall + 4)}px`; // people taller than the page are named inside it
    }
  }

  // What was given in this frame, and how deep people are in each other; or that they have come to their last one.
  said(people, take) {
    if (this.frame >= this.meta.lengths[people[0].take]) return "ended";
    const depth = this.view.marks ? this.picture.marks.deepest(this.frame, take) : 0;
    const deep = depth > 0 ? `${Math.round(100 * depth)} cm in each other` : "";
    return [this.view.said(this.frame, people), deep].filter((text) => text).join(" \u00b7 ");
  }

  // Pixels from a take to the next.
  gap() {
    const { distance, azimuth } = this.view;
    const metre = this.picture.canvas.clientHeight / (2 * Math.tan(FIELD / 2) * distance);
    return metre * this.apart * Math.abs(Math.cos(azimuth));
  }

  // Where on the page a take's label is.
  overhead(people) {
    const [x, , z] = this.centre(people);
    return this.picture.onPage([x, HEAD_HIGH, z]);
  }

  // A line of a legend: words after a dot of their ink.
  entry(id, words, ink) {
    const entry = document.getElementById(id).appendChild(document.createElement("span"));
    entry.textContent = words;
    entry.style.setProperty("--ink", ink);
  }

  controls() {
    const get = (id) => document.getElementById(id);
    const { meta, view } = this;
    // Who comes back to the page finds it as it plays, not with choices that the browser has kept.
    for (const control of document.querySelectorAll("input, select")) control.autocomplete = "off";
    get("time").max = meta.frames - 1;
    get("time").addEventListener("input", (event) => this.seek(Number(event.target.value)));
    get("play").addEventListener("click", () => this.play(!this.playing));
    get("back").addEventListener("click", () => this.seek(this.frame - 1));
    get("next").addEventListener("click", () => this.seek(this.frame + 1));
    get("speed").addEventListener("change", (event) => (this.speed = Number(event.target.value)));
    get("loop").addEventListener("change", (event) => (this.loop = event.target.checked));
    get("take").hidden = meta.takes.length === 1;
    for (const [index, name] of ["side by side", ...meta.takes].entries()) get("take").add(new Option(name, index - 1));
    get("take").addEventListener("change", (event) => this.choose(Number(event.target.value)));
    if (meta.takes.length > 1) get("from").value = "front";
    for (const style of meta.styles) get("style").add(new Option(style, style));
    get("style").addEventListener("change", (event) => (view.style = event.target.value));
    get("ghosts").hidden = !meta.people.some((person) => person.ghost);
    get("truth").addEventListener("change", (event) => (view.ghosts = event.target.checked));
    get("marked").hidden = !this.picture.marks.kinds.size;
    for (const [words, ink] of this.picture.marks.legend()) this.entry("legend", words, ink);
    get("marks").addEventListener("change", (event) => {
      view.marks = event.target.checked;
      get("legend").hidden = !view.marks;
      this.ribbon();
    });
    get("follow").addEventListener("change", (event) => (view.follow = event.target.checked));
    get("from").addEventListener("change", (event) => view.preset(event.target.value));
    window.addEventListener("resize", () => this.resized());
    document.addEventListener("keydown", (event) => {
      const { tagName, type } = event.target;
      if (tagName === "SELECT" || event.altKey || event.ctrlKey || event.metaKey) return; // the browser's own
      if (event.key === " " && (tagName === "BUTTON" || type === "checkbox")) return; // which it presses
      const [dx, dy] = ARROWS[event.key] ?? [0, 0];
      if (event.key === " ") this.play(!this.playing);
      else if (ZOOMS[event.key]) view.zoom(ZOOMS[event.key]);
      else if (event.shiftKey && (dx || dy)) view.turn(15 * dx, 15 * dy);
      else if (event.key === "ArrowLeft") this.seek(this.frame - 1);
      else if (event.key === "ArrowRight") this.seek(this.frame + 1);
      else return;
      event.preventDefault();
    });
  }
}

function begin() {
  try {
    window.player = new Player(readData());
  } catch (error) {
    const failed = document.getElementById("failed");
    failed.style.display = "flex";
    failed.textContent = error.message;
    throw error;
  }
}

// A notebook may hold many of these pages, and a browser drops the oldest of over 16 pictures: a page begins when it is
// first in sight, stands still while it is not, and begins anew if its picture was dropped.
new IntersectionObserver((changes) => {
  const seen = changes.at(-1).isIntersecting;
  if (window.player) player.seen = seen;
  else if (seen) begin();
  if (seen) window.player?.wake();
  if (seen && window.player && player.picture.gl.isContextLost()) location.reload();
}).observe(document.body);
