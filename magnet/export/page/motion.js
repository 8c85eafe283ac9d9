// What the page holds, and the poses of its people. No libraries, no network.
//
// Everybody is a mesh at rest, bent by 22 bones. A frame holds the world turn of each bone and the place of the
// pelvis; the other places follow from the rest pose.
"use strict";

const BONES = 22;

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
