// The camera and the controls: plays people from the two elements #meta (JSON) and #data (base64).

const PRESETS = { "three quarters": [0.65, 0.3], front: [0, 0.12], side: [Math.PI / 2, 0.12], above: [0, 1.45] };
const ALL = -1; // takes, side by side
const HEAD_HIGH = 2.3; // metres, where a take's label is
const DEPTHS = 5; // pixels of the timeline's stripe of depths
const FARTHEST = 80; // metres that the camera may be away
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const ZOOMS = { "+": 0.87, "=": 0.87, "-": 1.15, "_": 1.15 };
const MOMENTS = 21; // at which is measured how much room people take

// A stripe of the timeline: a background of CSS with a colour for each frame.
function stripe(frames, colour, top, height) {
  const stops = [];
  for (let from = 0, to; from < frames; from = to) {
    const ink = colour(from);
    for (to = from + 1; to < frames && colour(to) === ink; ) to++;
    stops.push(`${ink} ${(100 * from) / frames}% ${(100 * to) / frames}%`);
  }
  return `linear-gradient(90deg, ${stops.join(", ")}) 0 ${top}px / 100% ${height}px no-repeat`;
}

// -- camera -------------------------------------------------------------------------------------

class View {
  constructor(canvas, meta, arrays) {
    this.known = arrays.known; // (T, M)
    this.anyGiven = this.known.some((given) => given);
    this.people = meta.people.map((person, index) => ({ ...person, index }));
    this.style = meta.styles[0];
    this.ghosts = true;
    this.marks = true;
    this.follow = true;
    this.target = [0, 0.85, 0];
    this.preset(meta.takes.length > 1 ? "front" : "three quarters");
    this.choose(ALL);
    this.listen(canvas);
  }

  // Look at one take, or at all side by side.
  choose(take) {
    this.take = take;
    const there = this.people.filter((person) => take === ALL || person.take === take);
    this.shown = there.filter((person) => !person.ghost);
    this.behind = there.filter((person) => person.ghost);
  }

  given(frame, person) {
    return this.known[frame * this.people.length + person] > 0;
  }

  // Whose motion was given in a frame; nothing where none at all was.
  said(frame, people) {
    if (!this.anyGiven) return "";
    const those = people.filter((person) => this.given(frame, person.index));
    if (those.length === people.length) return "given";
    return those.length ? `given: ${those.map((person) => person.name).join(", ")}` : "generated";
  }

  // A stripe a person for the timeline, pale where the motion was given, and below them one of how deep people are in
  // each other, if they are: backgrounds of CSS, and their height.
  ribbon(frames, marks) {
    const people = Math.min(24, Math.max(6, 4 * this.shown.length));
    const each = people / this.shown.length;
    const stripes = this.shown.map((person, row) => {
      const colour = (frame) => `rgb(${this.given(frame, person.index) ? person.pale : person.colour})`;
      return stripe(frames, colour, row * each, each);
    });
    const depths = Array.from({ length: frames }, (_, frame) => (this.marks ? marks.deepest(frame, this.take) : 0));
    if (!depths.some((depth) => depth > 0)) return [stripes.join(", "), `${people}px`];
    const deep = (frame) => (depths[frame] ? `rgb(${marks.depthColour(depths[frame])})` : "#e8ebf1");
    stripes.push(stripe(frames, deep, people + 1, DEPTHS));
    return [stripes.join(", "), `${people + 1 + DEPTHS}px`];
  }

  preset(name) {
    [this.azimuth, this.elevation] = PRESETS[name];
  }

  eye() {
    const flat = this.distance * Math.cos(this.elevation);
    return [
      this.target[0] + flat * Math.sin(this.azimuth),
      this.target[1] + this.distance * Math.sin(this.elevation),
      this.target[2] + flat * Math.cos(this.azimuth),
    ];
  }

  goTo(centre, share) {
    this.target[0] += share * (centre[0] - this.target[0]);
    this.target[2] += share * (centre[2] - this.target[2]);
  }

  turn(dx, dy) {
    this.azimuth -= 0.008 * dx;
    this.elevation = Math.min(Math.max(this.elevation + 0.006 * dy, -0.05), 1.5);
  }

  move(dx, dy) {
    const scale = 0.0016 * this.distance;
    this.target[0] -= scale * dx * Math.cos(this.azimuth);
    this.target[2] += scale * dx * Math.sin(this.azimuth);
    this.target[1] = Math.min(Math.max(this.target[1] + scale * dy, 0), 3);
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 0.8), FARTHEST);
  }

  // One finger or the left button turns, the right button or shift moves, two fingers or the wheel zoom.
  listen(canvas) {
    const touching = new Map();
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(0.001 * event.deltaY));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      touching.set(event.pointerId, event);
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, (event) => touching.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const before = touching.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
      if (touching.size === 2) {
        const other = [...touching.values()].find((each) => each.pointerId !== event.pointerId);
        const span = (each) => Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY) || 1;
        this.zoom(span(before) / span(event));
      } else if (event.shiftKey || event.buttons & 2) {
        this.follow = false;
        document.getElementById("follow").checked = false;
        this.move(dx, dy);
      } else this.turn(dx, dy);
      touching.set(event.pointerId, event);
    });
  }
}

// -- playing ------------------------------------------------------------------------------------

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
    let last = performance.now();
    const tick = (now) => {
      if (this.seen) this.advance(Math.max(0, now - last) / 1000); // the first one may lie before the page was ready
      last = now;
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
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
    [style.background, style.height] = this.view.ribbon(this.meta.frames, this.picture.marks);
  }

  advance(seconds) {
    if (this.playing) {
      this.time += seconds * this.meta.fps * this.speed;
      if (this.time > this.meta.frames - 1) {
        if (this.loop) this.time = 0;
        else {
          this.time = this.meta.frames - 1;
          this.play(false);
        }
      }
    }
    if (this.view.follow) this.view.goTo(this.centre(), Math.min(1, 4 * seconds));
    this.picture.draw(this.motion, this.time, this.view);
    this.drawn += 1;
    this.show();
  }

  play(on) {
    if (on && this.frame >= this.meta.frames - 1) this.time = 0;
    this.playing = on;
  }

  seek(frame) {
    this.playing = false;
    this.time = Math.min(Math.max(frame, 0), this.meta.frames - 1);
  }

  show() {
    const { meta, frame } = this;
    const get = (id) => document.getElementById(id);
    get("play").textContent = this.playing ? "Pause" : "Play";
    get("time").value = frame;
    get("clock").textContent = `${(frame / meta.fps).toFixed(2)} s / ${((meta.frames - 1) / meta.fps).toFixed(1)} s`;
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
    for (const [words, ink] of this.picture.marks.legend()) {
      const entry = get("legend").appendChild(document.createElement("span"));
      entry.textContent = words;
      entry.style.setProperty("--ink", ink);
    }
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
  if (seen && window.player && player.picture.gl.isContextLost()) location.reload();
}).observe(document.body);
