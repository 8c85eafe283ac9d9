// Plays people from the two elements #meta (JSON) and #data (base64). WebGL 2; no libraries, no network.
//
// Everybody is a mesh at rest, bent in the vertex shader by 22 bones. A frame holds the world turn of each bone
// and the place of the pelvis; the other places follow from the rest pose.
"use strict";

const BONES = 22;
const FIELD = 0.62; // vertical angle of view, radians
const PRESETS = { "three quarters": [0.65, 0.3], front: [0, 0.12], side: [Math.PI / 2, 0.12], above: [0, 1.45] };
const LIGHT = unit([-0.15, 0.9, 0.62]);
const ALL = -1; // takes, side by side
const HEAD_HIGH = 2.3; // metres, where a take's label is
const MOMENTS = 21; // at which is measured how much room people take

// -- vectors and matrices -----------------------------------------------------------------------

function unit(v) {
  const length = Math.hypot(...v) || 1;
  return v.map((x) => x / length);
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// 4 x 4 matrices are column-major, as WebGL wants them.
function multiply(a, b) {
  const out = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + row] * b[4 * column + k];
      out[4 * column + row] = sum;
    }
  return out;
}

function perspective(field, aspect, near, far) {
  const f = 1 / Math.tan(field / 2);
  const d = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, (2 * far * near) / d, 0]);
}

function lookAt(eye, centre) {
  const back = unit([eye[0] - centre[0], eye[1] - centre[1], eye[2] - centre[2]]);
  const right = unit(cross([0, 1, 0], back));
  const up = cross(back, right);
  return new Float32Array([
    right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
  ]);
}

// -- data ---------------------------------------------------------------------------------------

const TYPES = { i16: Int16Array, u16: Uint16Array, u32: Uint32Array, u8: Uint8Array, f32: Float32Array };

function readData() {
  const meta = JSON.parse(document.getElementById("meta").textContent);
  const text = atob(document.getElementById("data").textContent.trim());
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const arrays = {};
  for (const [name, { type, offset, length }] of Object.entries(meta.arrays))
    arrays[name] = new TYPES[type](bytes.buffer, offset, length);
  return { meta, arrays };
}

// Poses of one person at a time between two frames: bone matrices as 3 rows of 4 for each bone.
class Motion {
  constructor(meta, arrays) {
    this.meta = meta;
    this.turns = arrays.turns; // (T, M, 22, 4) wxyz in 1 / 32767
    this.roots = arrays.roots; // (T, M, 3) metres
    this.rest = arrays.rest; // (shapes, 22, 3) metres
    this.rows = new Float32Array(BONES * 12);
    this.places = new Float32Array(BONES * 3);
  }

  root(person, time) {
    const [from, to, share] = this.between(time);
    const M = this.meta.people.length;
    const at = (t, k) => this.roots[(t * M + person) * 3 + k];
    return [0, 1, 2].map((k) => at(from, k) + share * (at(to, k) - at(from, k)));
  }

  between(time) {
    const from = Math.min(Math.floor(time), this.meta.frames - 1);
    return [from, Math.min(from + 1, this.meta.frames - 1), time - from];
  }

  pose(person, time) {
    const [from, to, share] = this.between(time);
    const { turns, rest, rows, places, meta } = this;
    const M = meta.people.length;
    const restAt = meta.people[person].shape * BONES * 3;
    for (let bone = 0; bone < BONES; bone++) {
      const a = ((from * M + person) * BONES + bone) * 4;
      const b = ((to * M + person) * BONES + bone) * 4;
      // Neighbouring frames are stored on the same side of the sphere of quaternions.
      let w = turns[a] + share * (turns[b] - turns[a]);
      let x = turns[a + 1] + share * (turns[b + 1] - turns[a + 1]);
      let y = turns[a + 2] + share * (turns[b + 2] - turns[a + 2]);
      let z = turns[a + 3] + share * (turns[b + 3] - turns[a + 3]);
      const length = Math.hypot(w, x, y, z) || 1;
      w /= length; x /= length; y /= length; z /= length;
      const r = bone * 12;
      rows[r] = 1 - 2 * (y * y + z * z); rows[r + 1] = 2 * (x * y - w * z); rows[r + 2] = 2 * (x * z + w * y);
      rows[r + 4] = 2 * (x * y + w * z); rows[r + 5] = 1 - 2 * (x * x + z * z); rows[r + 6] = 2 * (y * z - w * x);
      rows[r + 8] = 2 * (x * z - w * y); rows[r + 9] = 2 * (y * z + w * x); rows[r + 10] = 1 - 2 * (x * x + y * y);
    }
    const root = this.root(person, time);
    for (let bone = 0; bone < BONES; bone++) {
      const parent = meta.parents[bone];
      for (let k = 0; k < 3; k++) {
        if (parent < 0) { places[k] = root[k]; continue; }
        let at = places[parent * 3 + k];
        for (let c = 0; c < 3; c++)
          at += rows[parent * 12 + 4 * k + c] * (rest[restAt + bone * 3 + c] - rest[restAt + parent * 3 + c]);
        places[bone * 3 + k] = at;
      }
    }
    for (let bone = 0; bone < BONES; bone++)
      for (let k = 0; k < 3; k++) {
        let shift = places[bone * 3 + k];
        for (let c = 0; c < 3; c++) shift -= rows[bone * 12 + 4 * k + c] * rest[restAt + bone * 3 + c];
        rows[bone * 12 + 4 * k + 3] = shift;
      }
    return rows;
  }
}

// -- drawing ------------------------------------------------------------------------------------

const PEOPLE_VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec4 bone;
layout(location = 3) in vec4 weight;
uniform vec4 rows[${BONES * 3}];
uniform mat4 camera;
uniform float unit;
uniform vec3 light;
uniform bool shadow;
out vec3 at;
out vec3 facing;
void main() {
  vec4 x = vec4(position * unit, 1.0);
  vec3 place = vec3(0.0), turned = vec3(0.0);
  for (int k = 0; k < 4; k++) {
    int r = 3 * int(bone[k] + 0.5);
    place += weight[k] * vec3(dot(rows[r], x), dot(rows[r + 1], x), dot(rows[r + 2], x));
    turned += weight[k] * vec3(dot(rows[r].xyz, normal), dot(rows[r + 1].xyz, normal), dot(rows[r + 2].xyz, normal));
  }
  if (shadow) {
    place -= light * (max(place.y, 0.0) / light.y);
    place.y = 0.004;
  }
  at = place;
  facing = turned;
  gl_Position = camera * vec4(place, 1.0);
}`;

const PEOPLE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 at;
in vec3 facing;
uniform vec3 colour;
uniform float alpha;
uniform vec3 eye;
uniform vec3 light;
uniform bool shadow;
out vec4 ink;
void main() {
  if (shadow) { ink = vec4(0.20, 0.23, 0.32, alpha); return; }
  vec3 n = normalize(facing);
  vec3 toEye = normalize(eye - at);
  float toward = dot(n, light);
  float diffuse = max(0.30 + 0.70 * toward, 0.0);
  float rim = pow(1.0 - max(dot(n, toEye), 0.0), 3.0);
  float shade = 0.44 + 0.62 * diffuse + 0.14 * (0.5 + 0.5 * n.y) - 0.10 * rim;
  float gloss = pow(max(dot(reflect(-light, n), toEye), 0.0), 24.0);
  float pale = clamp(shade - 0.92, 0.0, 0.5) * 0.8 + 0.14 * gloss;
  ink = vec4(mix(colour * min(shade, 1.0), vec3(1.0), pale), alpha);
}`;

const FLOOR_VERTEX = `#version 300 es
layout(location = 0) in vec2 corner;
uniform mat4 camera;
uniform vec3 centre;
out vec2 at;
void main() {
  at = corner * 30.0 + centre.xz;
  gl_Position = camera * vec4(at.x, 0.0, at.y, 1.0);
}`;

const FLOOR_FRAGMENT = `#version 300 es
precision highp float;
in vec2 at;
uniform vec3 centre;
uniform float reach;
out vec4 ink;
void main() {
  vec2 tile = at / 0.5;
  vec2 blur = max(fwidth(tile), 1e-4);
  // The share of a pixel that lies on odd tiles: a triangle wave, limited where it would flicker.
  vec2 wave = clamp((abs(fract(tile * 0.5) - 0.5) - 0.25) / blur * 2.0 + 0.5, 0.0, 1.0);
  float odd = mix(wave.x + wave.y - 2.0 * wave.x * wave.y, 0.5, clamp(max(blur.x, blur.y) - 0.5, 0.0, 1.0));
  vec3 colour = mix(vec3(0.937, 0.945, 0.961), vec3(0.886, 0.902, 0.929), odd);
  float away = length(at - centre.xz) / reach;
  ink = vec4(mix(colour, vec3(0.980, 0.980, 0.988), clamp(away * away - 0.1, 0.0, 1.0)), 1.0);
}`;

class Picture {
  constructor(canvas, meta, arrays) {
    const wishes = { alpha: false, antialias: true, stencil: true, preserveDrawingBuffer: true };
    const gl = canvas.getContext("webgl2", wishes);
    if (!gl) throw new Error("This browser shows no WebGL 2: try another, or switch hardware acceleration on.");
    this.canvas = canvas;
    this.gl = gl;
    this.meta = meta;
    this.people = this.program(PEOPLE_VERTEX, PEOPLE_FRAGMENT);
    this.floor = this.program(FLOOR_VERTEX, FLOOR_FRAGMENT);
    this.quad = gl.createVertexArray();
    gl.bindVertexArray(this.quad);
    this.attribute(0, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), 2);
    this.meshes = {};
    for (const style of meta.styles) this.meshes[style] = this.mesh(style, arrays);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(0.98, 0.98, 0.988, 1);
  }

  program(vertex, fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  attribute(location, array, size, type = this.gl.FLOAT, normalized = false) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, type, normalized, 0, 0);
  }

  // One vertex array a shape: vertices and normals are its own, the rest is everybody's.
  mesh(style, arrays) {
    const gl = this.gl;
    const faces = arrays[style + "_faces"];
    const bones = arrays[style + "_bones"];
    const weights = arrays[style + "_weights"];
    const all = arrays[style + "_vertices"];
    const V = bones.length / 4;
    const vertexArrays = Array.from({ length: all.length / (V * 3) }, (_, shape) => {
      const vertices = all.subarray(shape * V * 3, (shape + 1) * V * 3);
      const vertexArray = gl.createVertexArray();
      gl.bindVertexArray(vertexArray);
      this.attribute(0, vertices, 3, gl.SHORT);
      this.attribute(1, normals(vertices, faces), 3);
      this.attribute(2, bones, 4, gl.UNSIGNED_BYTE);
      this.attribute(3, weights, 4, gl.UNSIGNED_SHORT, true);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
      return vertexArray;
    });
    gl.bindVertexArray(null);
    return { vertexArrays, count: faces.length, wide: faces instanceof Uint32Array };
  }

  draw(motion, time, view) {
    const gl = this.gl;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(this.canvas.clientWidth * ratio), Math.round(this.canvas.clientHeight * ratio)];
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    const eye = view.eye();
    this.camera = multiply(perspective(FIELD, width / height, 0.05, 200), lookAt(eye, view.target));
    this.drawFloor(view);
    const { program, uniforms } = this.people;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniforms.camera, false, this.camera);
    gl.uniform3fv(uniforms.light, LIGHT);
    gl.uniform3fv(uniforms.eye, eye);
    gl.uniform1f(uniforms.unit, this.meta.unit);
    const frame = Math.min(Math.floor(time), this.meta.frames - 1);
    this.shadows(motion, time, view.shown, view.style);
    for (const person of view.shown) {
      const colour = view.given(frame, person.index) ? person.pale : person.colour;
      this.figure(motion.pose(person.index, time), person.index, view.style, colour, 1);
    }
    if (view.ghosts) this.ghosts(motion, time, view.behind, view.style);
  }

  drawFloor(view) {
    const gl = this.gl;
    const { program, uniforms } = this.floor;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniforms.camera, false, this.camera);
    gl.uniform3fv(uniforms.centre, view.target);
    gl.uniform1f(uniforms.reach, Math.max(5, 1.8 * view.distance));
    gl.bindVertexArray(this.quad);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  // Flat shadows on the floor; the stencil lets each pixel darken once.
  shadows(motion, time, people, style) {
    const gl = this.gl;
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    gl.uniform1i(this.people.uniforms.shadow, 1);
    for (const { index } of people) this.figure(motion.pose(index, time), index, style, [0, 0, 0], 0.2);
    gl.uniform1i(this.people.uniforms.shadow, 0);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.disable(gl.STENCIL_TEST);
  }

  // First only their depth, so that of a ghost nothing but the nearest skin is seen.
  ghosts(motion, time, people, style) {
    const gl = this.gl;
    for (const { index, colour } of people) {
      const rows = motion.pose(index, time);
      gl.colorMask(false, false, false, false);
      this.figure(rows, index, style, colour, 1);
      gl.colorMask(true, true, true, true);
      gl.enable(gl.BLEND);
      gl.depthFunc(gl.LEQUAL);
      this.figure(rows, index, style, colour, 0.38);
      gl.depthFunc(gl.LESS);
      gl.disable(gl.BLEND);
    }
  }

  // Where a place in the world is on the page, or null behind the camera.
  onPage(place) {
    const m = this.camera;
    const [x, y, w] = [0, 1, 3].map((row) => dot([m[row], m[4 + row], m[8 + row]], place) + m[12 + row]);
    return w > 0 ? [((1 + x / w) * this.canvas.clientWidth) / 2, ((1 - y / w) * this.canvas.clientHeight) / 2] : null;
  }

  figure(rows, person, style, colour, alpha) {
    const gl = this.gl;
    const { uniforms } = this.people;
    const { vertexArrays, count, wide } = this.meshes[style];
    gl.uniform4fv(uniforms.rows, rows);
    gl.uniform3fv(uniforms.colour, colour.map((c) => c / 255));
    gl.uniform1f(uniforms.alpha, alpha);
    gl.bindVertexArray(vertexArrays[this.meta.people[person].shape]);
    gl.drawElements(gl.TRIANGLES, count, wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, 0);
  }
}

// Mean directions of the faces around each vertex, weighted by their areas.
function normals(vertices, faces) {
  const sum = new Float32Array(vertices.length);
  const edge = (i, j) => [0, 1, 2].map((k) => vertices[3 * j + k] - vertices[3 * i + k]);
  for (let f = 0; f < faces.length; f += 3) {
    const area = cross(edge(faces[f], faces[f + 1]), edge(faces[f], faces[f + 2]));
    for (let corner = 0; corner < 3; corner++)
      for (let k = 0; k < 3; k++) sum[3 * faces[f + corner] + k] += area[k];
  }
  for (let v = 0; v < sum.length; v += 3) {
    const length = Math.hypot(sum[v], sum[v + 1], sum[v + 2]) || 1;
    for (let k = 0; k < 3; k++) sum[v + k] /= length;
  }
  return sum;
}

// -- camera -------------------------------------------------------------------------------------

class View {
  constructor(canvas, meta, arrays) {
    this.known = arrays.known; // (T, M)
    this.anyGiven = this.known.some((given) => given);
    this.people = meta.people.map((person, index) => ({ ...person, index }));
    this.style = meta.styles[0];
    this.ghosts = true;
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

  // A stripe a person for the timeline, pale where the motion was given: backgrounds of CSS, and their height.
  ribbon(frames) {
    const height = Math.min(24, Math.max(6, 4 * this.shown.length));
    const stripes = this.shown.map((person, row) => {
      const stops = [];
      for (let from = 0, to; from < frames; from = to) {
        const given = this.given(from, person.index);
        for (to = from + 1; to < frames && this.given(to, person.index) === given; ) to++;
        const colour = `rgb(${given ? person.pale : person.colour})`;
        stops.push(`${colour} ${(100 * from) / frames}% ${(100 * to) / frames}%`);
      }
      const each = height / this.shown.length;
      return `linear-gradient(90deg, ${stops.join(", ")}) 0 ${row * each}px / 100% ${each}px no-repeat`;
    });
    return [stripes.join(", "), `${height}px`];
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
    this.distance = Math.min(Math.max(this.distance * factor, 0.8), 80);
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
    this.playing = true;
    this.loop = true;
    this.drawn = 0;
    const canvas = document.getElementById("canvas");
    this.motion = new Motion(meta, arrays);
    this.picture = new Picture(canvas, meta, arrays);
    this.view = new View(canvas, meta, arrays);
    this.labels = meta.takes.map(() => document.getElementById("labels").appendChild(document.createElement("div")));
    this.controls();
    this.choose(ALL);
    let last = performance.now();
    const tick = (now) => {
      this.advance(Math.max(0, now - last) / 1000); // the first one may lie before the page was ready
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
    const wide = widths.sort((a, b) => a - b)[Math.floor(0.8 * (MOMENTS - 1))];
    view.distance = Math.max(3.6, 2.2 * (wide / 2 + 0.7));
    view.goTo(this.centre(), 1);
    const { style } = document.getElementById("time");
    [style.background, style.height] = view.ribbon(meta.frames);
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
    if (document.activeElement !== get("time") || this.playing) get("time").value = frame;
    get("clock").textContent = `${(frame / meta.fps).toFixed(2)} s / ${((meta.frames - 1) / meta.fps).toFixed(1)} s`;
    const alone = meta.takes.length === 1 || this.view.take !== ALL;
    get("state").textContent = alone ? this.view.said(frame, this.view.shown) : "";
    for (const [take, label] of this.labels.entries()) {
      const people = alone ? [] : this.view.shown.filter((person) => person.take === take);
      const place = people.length && this.overhead(people);
      label.hidden = !place;
      if (!place) continue;
      [label.style.left, label.style.top] = place.map((x) => `${x}px`);
      label.textContent = [meta.takes[take], this.view.said(frame, people)].filter((text) => text).join(": ");
    }
  }

  // Where on the page a take's label is.
  overhead(people) {
    const [x, , z] = this.centre(people);
    return this.picture.onPage([x, HEAD_HIGH, z]);
  }

  controls() {
    const get = (id) => document.getElementById(id);
    const { meta, view } = this;
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
    get("follow").addEventListener("change", (event) => (view.follow = event.target.checked));
    get("from").addEventListener("change", (event) => view.preset(event.target.value));
    document.addEventListener("keydown", (event) => {
      if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) && event.target.type !== "range") return;
      if (event.key === " ") this.play(!this.playing);
      else if (event.key === "ArrowLeft") this.seek(this.frame - 1);
      else if (event.key === "ArrowRight") this.seek(this.frame + 1);
      else return;
      event.preventDefault();
    });
  }
}

try {
  window.player = new Player(readData());
} catch (error) {
  const failed = document.getElementById("failed");
  failed.style.display = "flex";
  failed.textContent = error.message;
  throw error;
}
