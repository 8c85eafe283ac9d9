// Who is looked at, from where, and what the timeline shows of them.

const PRESETS = { "three quarters": [0.65, 0.3], front: [0, 0.12], side: [Math.PI / 2, 0.12], above: [0, 1.45] };
const ALL = -1; // takes, side by side
const DEPTHS = 5; // pixels of the timeline's stripe of depths
const FARTHEST = 80; // metres that the camera may be away

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

  // A stripe a person for the timeline, pale (or dim) where the motion was given, and below them one of how deep people
  // are in each other, if they are: backgrounds of CSS, and their height.
  ribbon(frames, marks, faint) {
    const people = Math.min(24, Math.max(6, 4 * this.shown.length));
    const each = people / this.shown.length;
    const stripes = this.shown.map((person, row) => {
      const colour = (frame) => `rgb(${person[this.given(frame, person.index) ? faint : "colour"]})`;
      return stripe(frames, colour, row * each, each);
    });
    const depths = Array.from({ length: frames }, (_, frame) => (this.marks ? marks.deepest(frame, this.take) : 0));
    if (!depths.some((depth) => depth > 0)) return [stripes.join(", "), `${people}px`];
    const deep = (frame) => (depths[frame] ? `rgb(${marks.depthColour(depths[frame])})` : "var(--groove)");
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
