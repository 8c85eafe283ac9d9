// Marks on people: balls where bodies are in each other and where hands touch, discs under feet that slide.

const DEEP = 0; // kinds of marks: in each other, hands that touch, feet that slide
const FEET = 2;
const [RINGS, SECTORS] = [8, 14]; // of a ball
const ABOUT_MARK = 9; // numbers about a mark that is drawn: place, size, colour

const MARK_VERTEX = `#version 300 es
layout(location = 0) in vec3 corner;
layout(location = 1) in vec3 place;
layout(location = 2) in vec3 size;
layout(location = 3) in vec3 tint;
uniform mat4 camera;
out vec3 at;
out vec3 facing;
flat out vec3 colour;
void main() {
  at = place + size * corner;
  facing = corner / size;
  colour = tint;
  gl_Position = camera * vec4(at, 1.0);
}`;

const MARK_FRAGMENT = `#version 300 es
precision highp float;
in vec3 at;
in vec3 facing;
flat in vec3 colour;
uniform vec3 eye;
out vec4 ink;
void main() {
  float toward = max(dot(normalize(facing), normalize(eye - at)), 0.0);
  ink = vec4(colour * (0.8 + 0.2 * toward), 0.8);
}`;

class Marks {
  constructor(picture, meta, arrays) {
    this.places = arrays.mark_places; // (M, 3) metres
    this.facts = arrays.mark_facts; // (M, 4) take, kind, radius and depth in mm
    this.meta = meta.marks; // depths where the colours are amber and red, and the colours
    this.starts = new Uint32Array(meta.frames + 1); // the first mark of each frame
    for (const frame of arrays.mark_frames) this.starts[frame + 1]++;
    for (let frame = 0; frame < meta.frames; frame++) this.starts[frame + 1] += this.starts[frame];
    this.kinds = new Set(this.facts.filter((_, fact) => fact % 4 === 1));
    const { gl } = picture;
    this.gl = gl;
    this.program = picture.program(MARK_VERTEX, MARK_FRAGMENT);
    this.vertexArray = gl.createVertexArray();
    gl.bindVertexArray(this.vertexArray);
    const [corners, faces] = ball();
    picture.attribute(0, corners, 3);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    this.count = faces.length;
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    for (const location of [1, 2, 3]) {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 4 * ABOUT_MARK, 12 * (location - 1));
      gl.vertexAttribDivisor(location, 1);
    }
    gl.bindVertexArray(null);
  }

  // Marks of a frame in one take, or in all.
  at(frame, take) {
    const marks = [];
    for (let mark = this.starts[frame]; mark < this.starts[frame + 1]; mark++)
      if (take === ALL || this.facts[4 * mark] === take) marks.push(mark);
    return marks;
  }

  // Metres that people are in each other in a frame at most, 0 below 5 cm.
  deepest(frame, take) {
    const depths = this.at(frame, take).map((mark) => (this.facts[4 * mark + 1] === DEEP ? this.facts[4 * mark + 3] : 0));
    return Math.max(0, ...depths) / 1000;
  }

  // Amber where bodies begin to count as in each other, to red.
  depthColour(depth) {
    const { from, to, amber, red } = this.meta;
    const share = Math.min(Math.max((depth - from) / (to - from), 0), 1);
    return amber.map((x, k) => Math.round(x + share * (red[k] - x)));
  }

  colour(mark) {
    if (this.facts[4 * mark + 1] === DEEP) return this.depthColour(this.facts[4 * mark + 3] / 1000);
    return this.facts[4 * mark + 1] === FEET ? this.meta.amber : this.meta.hands;
  }

  // Words and ink (of CSS) of each kind of mark in this scene.
  legend() {
    const [amber, red, hands] = [this.meta.amber, this.meta.red, this.meta.hands].map((ink) => `rgb(${ink})`);
    const [from, to] = [this.meta.from, this.meta.to].map((depth) => Math.round(100 * depth));
    const deep = [`in each other, ${from} to ${to} cm and more`, `linear-gradient(90deg, ${amber}, ${red})`];
    return [deep, ["hands touch", hands], ["feet slide", amber]].filter((_, kind) => this.kinds.has(kind));
  }

  // All marks of a frame in one call.
  draw(camera, eye, frame, take) {
    const marks = this.at(frame, take);
    if (!marks.length) return;
    const about = new Float32Array(marks.length * ABOUT_MARK);
    for (const [row, mark] of marks.entries()) {
      const radius = this.facts[4 * mark + 2] / 1000;
      const flat = this.facts[4 * mark + 1] === FEET;
      const [x, y, z] = this.places.subarray(3 * mark, 3 * mark + 3);
      const ink = this.colour(mark).map((value) => value / 255);
      about.set([x, y + (flat ? 0.008 : 0), z, radius, flat ? 0.004 : radius, radius, ...ink], row * ABOUT_MARK);
    }
    const { gl } = this;
    const { program, uniforms } = this.program;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniforms.camera, false, camera);
    gl.uniform3fv(uniforms.eye, eye);
    gl.bindVertexArray(this.vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, about, gl.DYNAMIC_DRAW);
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    gl.drawElementsInstanced(gl.TRIANGLES, this.count, gl.UNSIGNED_SHORT, 0, marks.length);
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
  }
}

// A ball of radius 1: corners and faces that look outwards.
function ball() {
  const corners = [];
  const faces = [];
  for (let ring = 0; ring <= RINGS; ring++)
    for (let sector = 0; sector <= SECTORS; sector++) {
      const [down, round] = [(Math.PI * ring) / RINGS, (2 * Math.PI * sector) / SECTORS];
      corners.push(Math.sin(down) * Math.sin(round), Math.cos(down), Math.sin(down) * Math.cos(round));
      const here = ring * (SECTORS + 1) + sector;
      const below = here + SECTORS + 1;
      if (ring < RINGS && sector < SECTORS) faces.push(here, below, below + 1, here, below + 1, here + 1);
    }
  return [new Float32Array(corners), new Uint16Array(faces)];
}
