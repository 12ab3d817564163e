// Pictures: half-precision values to colours on a canvas, with limits, zoom and the value under the cursor.

const ANCHORS = {
  grey: ["#000000", "#ffffff"],
  viridis: ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"],
  inferno: ["#000004", "#1f0c48", "#550f6d", "#88226a", "#ba3655", "#e35933", "#f98c0a", "#f9c932", "#fcffa4"],
  difference: ["#2166ac", "#67a9cf", "#d1e5f0", "#f7f7f7", "#fddbc7", "#ef8a62", "#b2182b"],
};

/** 256 colours between the anchors, as red, green, blue. */
function table(name) {
  const anchors = ANCHORS[name].map((hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)));
  return Array.from({ length: 256 }, (_, step) => {
    const place = (step / 255) * (anchors.length - 1);
    const first = Math.min(Math.floor(place), anchors.length - 2);
    return [0, 1, 2].map((c) => anchors[first][c] + (place - first) * (anchors[first + 1][c] - anchors[first][c]));
  });
}

/** Values of all half-precision floats. */
const HALVES = Float32Array.from({ length: 65536 }, (_, bits) => {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
});

/** Decodes what the server sends: {name, about, shape, values}, of a live picture its sequence, of a stored one `of`. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const halves = new Uint16Array(buffer, 4 + length);
  const values = Float32Array.from(halves, (bits) => HALVES[bits] * head.scale);
  return { ...head, values };
}

/** The picture at an address; null if there is none (yet). */
export async function fetchPicture(address, signal) {
  const answer = await fetch(address, { signal });
  if (answer.status === 204) return null;
  if (!answer.ok) throw new Error(await answer.text());
  return decode(await answer.arrayBuffer());
}

/** Values below which the shares of all pixels lie, from at most 20,000 of them. */
function quantiles(values, shares) {
  const step = Math.max(1, Math.floor(values.length / 20000));
  const some = [];
  for (let at = 0; at < values.length; at += step) if (Number.isFinite(values[at])) some.push(values[at]);
  some.sort((a, b) => a - b);
  return shares.map((share) => (some.length ? some[Math.round(share * (some.length - 1))] : 0));
}

/** A number with three significant digits. */
export const number = (value) =>
  !Number.isFinite(value) ? "–" : value === 0 ? "0" : Math.abs(value) >= 1e5 || Math.abs(value) < 1e-3
    ? value.toExponential(2) : String(Number(value.toPrecision(4)));

/** Units of a picture, without what more is said of them. */
export const unitsOf = ({ about }) => (typeof about?.units === "string" ? about.units.split(";")[0] : null);

/** Makes an element; attributes `on...` are listeners. */
export const element = (name, attributes = {}, ...children) => {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== false && value != null) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child != null));
  return made;
};

/** What a list of figures contains, from pairs of a word and a text. */
export const pairs = (rows) => rows.flatMap(([key, value]) => [element("dt", {}, key), element("dd", {}, value)]);

/** Draws values into a canvas of one pixel each. */
export function paint(canvas, picture, colours, low, high) {
  const [rows, columns, channels = 1] = picture.shape;
  canvas.width = columns;
  canvas.height = rows;
  const context = canvas.getContext("2d");
  const image = context.createImageData(columns, rows);
  const map = table(colours).map((colour) => colour.map(Math.round));
  const scale = 255 / (high - low || 1);
  // Halves are rounded to 11 bits.
  const saturation = (picture.about?.saturation_dn ?? Infinity) * (1 - 2 ** -11);
  for (let pixel = 0; pixel < rows * columns; pixel += 1) {
    for (let c = 0; c < 3; c += 1) {
      const value = picture.values[pixel * channels + (channels === 3 ? c : 0)];
      const step = Math.max(0, Math.min(255, Math.round((value - low) * scale)));
      image.data[4 * pixel + c] = Number.isNaN(value) ? 0 : channels === 3 ? step : map[step][c];
    }
    // Saturated pixels are striped red and white, as a zebra.
    if (picture.values[pixel * channels] >= saturation) {
      const stripe = (Math.floor(pixel / columns) + (pixel % columns)) % 4 < 2 ? 255 : 40;
      [image.data[4 * pixel], image.data[4 * pixel + 1], image.data[4 * pixel + 2]] = [255, stripe, stripe];
    }
    image.data[4 * pixel + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

/**
 * A picture with its tools, in `place`. `onpixel(row, column)` is called for the pixel under the cursor, and, while
 * `selects` is set, `onregion([top, bottom, left, right])` for pixels over which the pointer is dragged. `marks` may
 * have a `frame` around such a region, and a `cross` at a row and column. Automatic limits are those of the values in
 * `range`, otherwise of the picture's own.
 */
export class Picture {
  constructor(place, { label, colours = "grey", onpixel = () => {}, onregion = () => {}, symmetric = false, range }) {
    this.colours = colours;
    this.range = range;
    this.symmetric = symmetric;
    this.onpixel = onpixel;
    this.onregion = onregion;
    this.selects = false;
    this.marks = {};
    /** Where a drag began, while it lasts. */
    this.grabbed = null;
    this.zoom = { factor: 1, x: 0, y: 0 };
    this.canvas = element("canvas", { class: "image", role: "img", "aria-label": label, tabindex: "0" });
    this.whole = document.createElement("canvas");
    const redraw = (change) => () => {
      change();
      this.draw();
    };
    this.choice = element("select",
      { "aria-label": "Colours", onchange: redraw(() => { this.colours = this.choice.value; }) },
      ...Object.keys(ANCHORS).map((name) => element("option", { value: name, selected: name === colours }, name)));
    const limit = (name) => element("input", { type: "number", step: "any", "aria-label": name,
      onchange: redraw(() => { this.auto.checked = false; }) });
    [this.low, this.high] = [limit("Lower limit"), limit("Upper limit")];
    this.auto = element("input", { type: "checkbox", checked: true, onchange: () => this.draw() });
    this.bar = element("canvas", { width: "256", height: "1", "aria-hidden": "true" });
    [this.from, this.to] = [element("span"), element("span")];
    this.readout = element("p", { class: "readout" });
    const reset = element("button",
      { type: "button", onclick: redraw(() => { this.zoom = { factor: 1, x: 0, y: 0 }; }) }, "Whole picture");
    this.element = element("div", { class: "picture" },
      element("div", { class: "stage" }, this.canvas),
      element("div", { class: "scale" }, this.from, this.bar, this.to),
      this.readout,
      element("div", { class: "tools" }, element("label", {}, "Colours ", this.choice),
        element("label", {}, this.auto, " automatic limits"),
        this.low, "to", this.high, reset));
    place.append(this.element);
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    this.canvas.addEventListener("pointerdown", (event) => this.grab(event));
    this.canvas.addEventListener("pointerup", () => this.release());
    this.canvas.addEventListener("pointercancel", () => { this.grabbed = null; });
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.magnify(event);
    }, { passive: false });
    this.canvas.addEventListener("keydown", (event) => this.step(event));
  }

  show(picture) {
    this.picture = picture;
    this.draw();
    if (this.at) this.tell();
  }

  mark(marks) {
    this.marks = marks;
    this.draw();
  }

  draw() {
    if (!this.picture) return;
    if (this.auto.checked) {
      let [low, high] = quantiles(this.range ?? this.picture.values, [0.005, 0.995]);
      if (this.symmetric) { high = Math.max(Math.abs(low), Math.abs(high)) || 1; low = -high; }
      else low = Math.min(low, 0);
      if (high <= low) high = low + 1;
      [this.low.value, this.high.value] = [low, high].map((limit) => Number(limit.toPrecision(3)));
    }
    const [low, high] = [Number(this.low.value), Number(this.high.value)];
    paint(this.whole, this.picture, this.colours, low, high);
    const { factor, x, y } = this.zoom;
    const [rows, columns] = this.picture.shape;
    this.canvas.style.width = `min(100%, ${(75 * columns) / rows}vh)`;
    // Small pictures are magnified by whole pixels, so that single ones can be told.
    const magnified = Math.max(1, Math.ceil(512 / columns));
    [this.canvas.width, this.canvas.height] = [columns * magnified, rows * magnified];
    const context = this.canvas.getContext("2d");
    context.imageSmoothingEnabled = false;
    context.drawImage(this.whole, x, y, columns / factor, rows / factor, 0, 0, this.canvas.width, this.canvas.height);
    this.drawMarks(context);
    const bar = { shape: [1, 256], values: Float32Array.from({ length: 256 }, (_, step) => step) };
    paint(this.bar, bar, this.colours, 0, 255);
    [this.from.textContent, this.to.textContent] = [number(low), number(high)];
  }

  drawMarks(context) {
    const { factor, x, y } = this.zoom;
    const scale = (factor * this.canvas.width) / this.picture.shape[1];
    const [across, down] = [(column) => (column - x) * scale, (row) => (row - y) * scale];
    const path = new Path2D();
    const frame = this.dragged ?? this.marks.frame;
    if (frame) {
      const [top, bottom, left, right] = frame;
      path.rect(across(left), down(top), (right - left) * scale, (bottom - top) * scale);
    }
    if (this.marks.cross) {
      const [row, column] = this.marks.cross;
      path.moveTo(0, down(row));
      path.lineTo(this.canvas.width, down(row));
      path.moveTo(across(column), 0);
      path.lineTo(across(column), this.canvas.height);
    }
    // Seen on dark and on bright pixels alike.
    const width = this.canvas.width / (this.canvas.clientWidth || this.canvas.width);
    for (const [colour, wide] of [["#000000", 3], ["#ffd54a", 1]]) {
      context.strokeStyle = colour;
      context.lineWidth = wide * width;
      context.stroke(path);
    }
  }

  /** Pixel under the pointer. */
  place(event) {
    const box = this.canvas.getBoundingClientRect();
    const [rows, columns] = this.picture.shape;
    // The picture is centred in its box, with its own ratio of sides.
    const scale = Math.min(box.width / columns, box.height / rows);
    const across = (event.clientX - box.left - (box.width - columns * scale) / 2) / scale;
    const down = (event.clientY - box.top - (box.height - rows * scale) / 2) / scale;
    const { factor, x, y } = this.zoom;
    return [y + down / factor, x + across / factor];
  }

  /** Pixels between two places, at least one. */
  region([row, column], [otherRow, otherColumn]) {
    const [rows, columns] = this.picture.shape;
    const within = (at, other, length) => {
      const first = Math.min(Math.max(Math.floor(Math.min(at, other)), 0), length - 1);
      return [first, Math.max(Math.min(Math.ceil(Math.max(at, other)), length), first + 1)];
    };
    return [...within(row, otherRow, rows), ...within(column, otherColumn, columns)];
  }

  /** The region dragged over so far; null if it is too small to be meant. */
  get dragged() {
    if (!this.grabbed?.to) return null;
    const [top, bottom, left, right] = this.region(this.grabbed.from, this.grabbed.to);
    return bottom - top > 2 && right - left > 2 ? [top, bottom, left, right] : null;
  }

  grab(event) {
    if (!this.picture || !this.selects || event.button !== 0) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.grabbed = { from: this.place(event), to: null };
  }

  release() {
    const region = this.dragged;
    this.grabbed = null;
    if (!region) return;
    this.onregion(region);
    this.draw();
  }

  point(event) {
    if (!this.picture) return;
    if (this.grabbed) {
      this.grabbed.to = this.place(event);
      this.draw();
    }
    const [row, column] = this.place(event).map(Math.floor);
    const [rows, columns] = this.picture.shape;
    if (row < 0 || column < 0 || row >= rows || column >= columns) return;
    this.at = [row, column];
    this.tell();
    this.onpixel(row, column);
  }

  tell() {
    const [row, column] = this.at;
    const [, columns, channels = 1] = this.picture.shape;
    const first = (row * columns + column) * channels;
    const values = Array.from(this.picture.values.subarray(first, first + channels), number).join(", ");
    this.readout.textContent = `row ${row}, column ${column}: ${values}`;
  }

  magnify(event) {
    if (!this.picture) return;
    const [row, column] = this.place(event);
    const [rows, columns] = this.picture.shape;
    const before = this.zoom.factor;
    const factor = Math.min(32, Math.max(1, before * (event.deltaY < 0 ? 1.25 : 0.8)));
    const clamp = (value, most) => Math.min(Math.max(0, value), most);
    this.zoom = {
      factor,
      x: clamp(column - ((column - this.zoom.x) * before) / factor, columns - columns / factor),
      y: clamp(row - ((row - this.zoom.y) * before) / factor, rows - rows / factor),
    };
    this.draw();
  }

  step(event) {
    const steps = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
    const step = steps[event.key];
    if (!step || !this.picture) return;
    event.preventDefault();
    const [rows, columns] = this.picture.shape;
    const [row, column] = this.at ?? [Math.floor(rows / 2), Math.floor(columns / 2)];
    this.at = [Math.min(Math.max(row + step[0], 0), rows - 1), Math.min(Math.max(column + step[1], 0), columns - 1)];
    this.tell();
    this.onpixel(...this.at);
  }
}
