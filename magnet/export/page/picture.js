// Draws people with WebGL 2: all who are looked at in one call, their shadows in another.
//
// The vertex shader finds the vertex at rest and its normal in a texture of all shapes, and the bones of its person
// in a texture of all poses.

const DARK = matchMedia("screen and (prefers-color-scheme: dark)"); // as the page's colours ask
const FIELD = 0.62; // vertical angle of view, radians
const LIGHT = unit([-0.15, 0.9, 0.62]);
const WIDE = 2048; // texels in a row of the shapes' texture, which every browser has room for
const ROWS = 3 * BONES; // texels of a pose: three rows of each bone's matrix
const ABOUT = 5; // numbers about a person who is drawn: row of the pose, shape, colour

const PEOPLE_VERTEX = `#version 300 es
precision highp float;
precision highp sampler2D;
layout(location = 0) in vec4 bone;
layout(location = 1) in vec4 weight;
layout(location = 2) in vec2 person;
layout(location = 3) in vec3 tint;
uniform sampler2D poses;
uniform sampler2D shapes;
uniform int vertices;
uniform mat4 camera;
uniform float unit;
uniform vec3 light;
uniform bool shadow;
out vec3 at;
out vec3 facing;
flat out vec3 colour;
void main() {
  int texel = 2 * (int(person.y) * vertices + gl_VertexID);
  ivec2 place = ivec2(texel % ${WIDE}, texel / ${WIDE});
  vec4 x = vec4(texelFetch(shapes, place, 0).xyz * unit, 1.0);
  vec3 normal = texelFetch(shapes, place + ivec2(1, 0), 0).xyz;
  vec3 bent = vec3(0.0), turned = vec3(0.0);
  for (int k = 0; k < 4; k++) {
    if (weight[k] == 0.0) continue;
    ivec2 row = ivec2(3 * int(bone[k] + 0.5), int(person.x));
    vec4 a = texelFetch(poses, row, 0);
    vec4 b = texelFetch(poses, row + ivec2(1, 0), 0);
    vec4 c = texelFetch(poses, row + ivec2(2, 0), 0);
    bent += weight[k] * vec3(dot(a, x), dot(b, x), dot(c, x));
    turned += weight[k] * vec3(dot(a.xyz, normal), dot(b.xyz, normal), dot(c.xyz, normal));
  }
  if (shadow) {
    bent -= light * (max(bent.y, 0.0) / light.y);
    bent.y = 0.004;
  }
  at = bent;
  facing = turned;
  colour = tint;
  gl_Position = camera * vec4(bent, 1.0);
}`;

const PEOPLE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 at;
in vec3 facing;
flat in vec3 colour;
uniform float alpha;
uniform vec3 eye;
uniform vec3 light;
uniform bool shadow;
uniform vec3 shade;
out vec4 ink;
void main() {
  if (shadow) { ink = vec4(shade, alpha); return; }
  vec3 n = normalize(facing);
  vec3 toEye = normalize(eye - at);
  float toward = dot(n, light);
  float diffuse = max(0.30 + 0.70 * toward, 0.0);
  float rim = pow(1.0 - max(dot(n, toEye), 0.0), 3.0);
  float lit = 0.44 + 0.62 * diffuse + 0.14 * (0.5 + 0.5 * n.y) - 0.10 * rim;
  float gloss = pow(max(dot(reflect(-light, n), toEye), 0.0), 24.0);
  float pale = clamp(lit - 0.92, 0.0, 0.5) * 0.8 + 0.14 * gloss;
  ink = vec4(mix(colour * min(lit, 1.0), vec3(1.0), pale), alpha);
}`;

const FLOOR_VERTEX = `#version 300 es
layout(location = 0) in vec2 corner;
uniform mat4 camera;
uniform vec3 centre;
uniform float reach;
out vec2 at;
void main() {
  at = corner * max(30.0, 1.05 * reach) + centre.xz; // where it has faded away
  gl_Position = camera * vec4(at.x, 0.0, at.y, 1.0);
}`;

const FLOOR_FRAGMENT = `#version 300 es
precision highp float;
in vec2 at;
uniform vec3 centre;
uniform float reach;
uniform vec3 tiles[2];
uniform vec3 far;
out vec4 ink;
void main() {
  vec2 tile = at / 0.5;
  vec2 blur = max(fwidth(tile), 1e-4);
  // The share of a pixel that lies on odd tiles: a triangle wave, limited where it would flicker.
  vec2 wave = clamp((abs(fract(tile * 0.5) - 0.5) - 0.25) / blur * 2.0 + 0.5, 0.0, 1.0);
  float odd = mix(wave.x + wave.y - 2.0 * wave.x * wave.y, 0.5, clamp(max(blur.x, blur.y) - 0.5, 0.0, 1.0));
  vec3 colour = mix(tiles[0], tiles[1], odd);
  float away = length(at - centre.xz) / reach;
  ink = vec4(mix(colour, far, clamp(away * away - 0.1, 0.0, 1.0)), 1.0);
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
    this.arrays = arrays;
    this.meshes = {}; // of each style that was looked at
    this.rows = new Float32Array(meta.people.length * ROWS * 4);
    this.about = new Float32Array(meta.people.length * ABOUT);
    this.aboutBuffer = gl.createBuffer();
    this.poses = this.texture(ROWS, meta.people.length, this.rows);
    this.marks = new Marks(this, meta, arrays);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    this.theme(DARK.matches);
  }

  // The colours of a light page or a dark one, where shadows are deeper and given people dim, not pale.
  theme(dark) {
    const style = getComputedStyle(document.documentElement);
    const read = (name) => style.getPropertyValue(name).match(/[0-9a-f]{2}/gi).map((part) => parseInt(part, 16) / 255);
    this.far = read("--far");
    this.tiles = new Float32Array([...read("--tile"), ...read("--other")]);
    [this.shade, this.shadow] = dark ? [[0, 0, 0], 0.5] : [[0.2, 0.23, 0.32], 0.2];
    this.faint = dark ? "dim" : "pale";
    this.gl.clearColor(...this.far, 1);
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

  // Four numbers a texel, read as they are.
  texture(width, height, numbers) {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, numbers);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  // A style's mesh: faces, bones and weights are everybody's, vertices and normals lie in a texture, shape by shape.
  mesh(style) {
    if (this.meshes[style]) return this.meshes[style];
    const gl = this.gl;
    const [faces, bones, weights, all] = ["faces", "bones", "weights", "vertices"].map(
      (name) => this.arrays[`${style}_${name}`],
    );
    const V = bones.length / 4;
    const texels = new Float32Array(4 * WIDE * Math.ceil((2 * all.length) / 3 / WIDE));
    for (let first = 0; first < all.length / 3; first += V) {
      const vertices = all.subarray(3 * first, 3 * (first + V));
      const facing = normals(vertices, faces);
      for (let v = 0; v < V; v++) {
        texels.set(vertices.subarray(3 * v, 3 * v + 3), 8 * (first + v));
        texels.set(facing.subarray(3 * v, 3 * v + 3), 8 * (first + v) + 4);
      }
    }
    const vertexArray = gl.createVertexArray();
    gl.bindVertexArray(vertexArray);
    this.attribute(0, bones, 4, gl.UNSIGNED_BYTE);
    this.attribute(1, weights, 4, gl.UNSIGNED_SHORT, true);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    for (const location of [2, 3]) {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribDivisor(location, 1);
    }
    gl.bindVertexArray(null);
    const shapes = this.texture(WIDE, texels.length / 4 / WIDE, texels);
    const kind = faces instanceof Uint32Array ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT;
    return (this.meshes[style] = { vertexArray, shapes, vertices: V, count: faces.length, kind });
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
    gl.uniform3fv(uniforms.shade, this.shade);
    gl.uniform1i(uniforms.poses, 0);
    gl.uniform1i(uniforms.shapes, 1);
    this.pose(motion, time, view);
    this.shadows(view.shown.length, view.style);
    this.figures(0, view.shown.length, view.style, 1);
    if (view.marks) this.marks.draw(this.camera, eye, Math.min(Math.floor(time), this.meta.frames - 1), view.take);
    if (view.ghosts && view.behind.length) gl.useProgram(program);
    if (view.ghosts) for (let i = 0; i < view.behind.length; i++) this.ghost(view.shown.length + i, view.style);
  }

  // Hand over how everybody stands and looks in this moment, ghosts last.
  pose(motion, time, view) {
    const gl = this.gl;
    const frame = Math.min(Math.floor(time), this.meta.frames - 1);
    const people = view.ghosts ? [...view.shown, ...view.behind] : view.shown;
    for (const [row, { index, shape, colour, [this.faint]: faint }] of people.entries()) {
      this.rows.set(motion.pose(index, time), row * ROWS * 4);
      const tint = view.given(frame, index) ? faint : colour;
      this.about.set([row, shape, tint[0] / 255, tint[1] / 255, tint[2] / 255], row * ABOUT);
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.poses);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROWS, people.length, gl.RGBA, gl.FLOAT, this.rows);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.aboutBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, this.about, gl.DYNAMIC_DRAW);
  }

  drawFloor(view) {
    const gl = this.gl;
    const { program, uniforms } = this.floor;
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniforms.camera, false, this.camera);
    gl.uniform3fv(uniforms.centre, view.target);
    gl.uniform1f(uniforms.reach, Math.max(5, 1.8 * view.distance));
    gl.uniform3fv(uniforms.tiles, this.tiles);
    gl.uniform3fv(uniforms.far, this.far);
    gl.bindVertexArray(this.quad);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  // Flat shadows on the floor of the first people; the stencil lets each pixel darken once.
  shadows(count, style) {
    const gl = this.gl;
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    gl.uniform1i(this.people.uniforms.shadow, 1);
    this.figures(0, count, style, this.shadow);
    gl.uniform1i(this.people.uniforms.shadow, 0);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.disable(gl.STENCIL_TEST);
  }

  // First only its depth, so that nothing but the nearest skin is seen; one by one, so that they shine through.
  ghost(row, style) {
    const gl = this.gl;
    gl.colorMask(false, false, false, false);
    this.figures(row, 1, style, 1);
    gl.colorMask(true, true, true, true);
    gl.enable(gl.BLEND);
    gl.depthFunc(gl.LEQUAL);
    this.figures(row, 1, style, 0.38);
    gl.depthFunc(gl.LESS);
    gl.disable(gl.BLEND);
  }

  // Where a place in the world is on the page, or null behind the camera.
  onPage(place) {
    const m = this.camera;
    const [x, y, w] = [0, 1, 3].map((row) => dot([m[row], m[4 + row], m[8 + row]], place) + m[12 + row]);
    return w > 0 ? [((1 + x / w) * this.canvas.clientWidth) / 2, ((1 - y / w) * this.canvas.clientHeight) / 2] : null;
  }

  // People in rows first, first + 1 ... of the poses, in one call.
  figures(first, people, style, alpha) {
    const gl = this.gl;
    const { uniforms } = this.people;
    gl.activeTexture(gl.TEXTURE1);
    const { vertexArray, shapes, vertices, count, kind } = this.mesh(style);
    gl.bindTexture(gl.TEXTURE_2D, shapes);
    gl.uniform1i(uniforms.vertices, vertices);
    gl.uniform1f(uniforms.alpha, alpha);
    gl.bindVertexArray(vertexArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.aboutBuffer);
    gl.vertexAttribPointer(2, 2, gl.FLOAT, false, 4 * ABOUT, 4 * ABOUT * first);
    gl.vertexAttribPointer(3, 3, gl.FLOAT, false, 4 * ABOUT, 4 * ABOUT * first + 8);
    gl.drawElementsInstanced(gl.TRIANGLES, count, kind, 0, people);
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

