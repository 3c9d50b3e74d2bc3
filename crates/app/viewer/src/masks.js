// A photograph with its mask, and the brush that corrects it.

/** Usual width of the brush, as a share of the picture's longer side. */
const WIDTH = 0.04;
/** How bright the background is shown. */
const BEHIND = 0.25;

/** Bones by the part of the body: pairs of joints. A note stands beside the second joint of a part. */
const BONES = {
  "left-arm": [[11, 13], [13, 15], [15, 19]],
  "right-arm": [[12, 14], [14, 16], [16, 20]],
  "left-leg": [[23, 25], [25, 27], [27, 31]],
  "right-leg": [[24, 26], [26, 28], [28, 32]],
  head: [[7, 0], [0, 8]],
  torso: [[11, 12], [11, 23], [12, 24], [23, 24]],
};
/** Least probability of a joint that is drawn. */
const SEEN = 0.5;

const canvasOf = (width, height) => Object.assign(document.createElement("canvas"), { width, height });

export class Drawing {
  /** `drawn` gets the drawing after each change of its strokes. */
  constructor(canvas, drawn) {
    this.canvas = canvas;
    this.drawn = drawn;
    this.keeps = true;
    this.width = WIDTH;
    this.ring = canvas.parentElement.querySelector(".ring");
    this.clear();
    // Mouse and pen. One finger scrolls, two paint.
    canvas.addEventListener("pointerdown", (event) => {
      if (event.pointerType !== "touch" && event.button === 0 && this.begin()) {
        canvas.setPointerCapture(event.pointerId);
        this.pointer = event.pointerId;
        this.extend(event);
      }
    });
    canvas.addEventListener("pointermove", (event) => {
      this.showRing(event.pointerType === "touch" ? null : event);
      if (this.current && event.pointerId === this.pointer) {
        // A fast hand moves several times between two events.
        (event.getCoalescedEvents?.() ?? []).forEach((moved) => this.place(moved));
        this.extend(event);
      }
    });
    canvas.addEventListener("pointerleave", () => this.showRing(null));
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => event.pointerId === this.pointer && this.end());
    }
    const middle = ([a, b]) => ({ clientX: (a.clientX + b.clientX) / 2, clientY: (a.clientY + b.clientY) / 2 });
    canvas.addEventListener("touchstart", (event) => {
      if (event.touches.length === 2 && this.begin()) {
        event.preventDefault();
        this.showRing(middle(event.touches));
        this.extend(middle(event.touches));
      }
    });
    canvas.addEventListener("touchmove", (event) => {
      if (event.touches.length === 2) {
        event.preventDefault();
        if (this.current) {
          this.showRing(middle(event.touches));
          this.extend(middle(event.touches));
        }
      }
    });
    for (const kind of ["touchend", "touchcancel"]) {
      canvas.addEventListener(kind, () => {
        this.showRing(null);
        this.end();
      });
    }
  }

  /** Begins a line if there is a picture and no other line. */
  begin() {
    if (!this.picture || this.current) {
      return false;
    }
    this.current = { keeps: this.keeps, width: this.width * Math.max(this.canvas.width, this.canvas.height), points: [], shown: 0 };
    this.lines.push(this.current);
    this.undone = [];
    return true;
  }

  end() {
    if (this.current) {
      this.current = null;
      this.pointer = null;
      this.drawn(this);
    }
  }

  /** Shows the brush's size at the place of an event. */
  showRing(event) {
    this.ring.classList.toggle("hidden", !event || !this.picture);
    if (event) {
      const [box, around] = [this.canvas, this.ring.parentElement].map((part) => part.getBoundingClientRect());
      const size = this.width * Math.max(box.width, box.height);
      Object.assign(this.ring.style, {
        width: `${size}px`,
        height: `${size}px`,
        left: `${event.clientX - around.left + this.ring.parentElement.scrollLeft}px`,
        top: `${event.clientY - around.top + this.ring.parentElement.scrollTop}px`,
        borderColor: this.keeps ? "#fff" : "#f66",
      });
    }
  }

  /** Enlarges the picture in its frame, which then scrolls. */
  zoom(factor) {
    this.canvas.style.setProperty("--zoom", factor);
  }

  setWidth(share) {
    this.width = share;
  }

  clear() {
    this.picture = null;
    this.joints = [];
    this.notes = {};
    this.lines = [];
    this.undone = [];
    this.current = null;
    this.drawn(this);
  }

  /** Shows a picture and its mask, white on the person, both of one size, and the person's joints. */
  open(picture, mask, joints) {
    this.clear();
    this.picture = picture;
    this.joints = joints;
    [this.canvas.width, this.canvas.height] = [picture.width, picture.height];
    this.canvas.style.setProperty("--aspect", picture.width / picture.height);
    // A canvas masks by transparency, not by brightness.
    const grey = canvasOf(mask.width, mask.height).getContext("2d");
    grey.drawImage(mask, 0, 0);
    const pixels = grey.getImageData(0, 0, mask.width, mask.height);
    for (let i = 0; i < pixels.data.length; i += 4) {
      pixels.data[i + 3] = pixels.data[i];
    }
    this.base = canvasOf(mask.width, mask.height);
    this.base.getContext("2d").putImageData(pixels, 0, 0);
    this.mask = canvasOf(mask.width, mask.height);
    this.cut = canvasOf(mask.width, mask.height);
    this.renew();
  }

  undo() {
    this.move(this.lines, this.undone);
  }

  redo() {
    this.move(this.undone, this.lines);
  }

  move(from, to) {
    if (this.current || from.length === 0) {
      return;
    }
    to.push(from.pop());
    this.renew();
    this.drawn(this);
  }

  place(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * this.canvas.width;
    const y = ((event.clientY - box.top) / box.height) * this.canvas.height;
    this.current.points.push([x, y]);
  }

  extend(event) {
    this.place(event);
    const { points, shown } = this.current;
    this.onMask({ ...this.current, points: points.slice(Math.max(shown - 1, 0)) });
    this.current.shown = points.length;
    // Events may come faster than frames.
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      if (this.picture) {
        this.show();
      }
    });
  }

  /** Draws a line in a color. */
  line(context, { width, points }, color) {
    Object.assign(context, { lineWidth: width, lineCap: "round", lineJoin: "round", strokeStyle: color });
    context.beginPath();
    context.moveTo(...points[0]);
    // A single point is a line as well.
    points.forEach((point) => context.lineTo(...point));
    context.stroke();
  }

  onMask(line) {
    const context = this.mask.getContext("2d");
    context.globalCompositeOperation = line.keeps ? "source-over" : "destination-out";
    this.line(context, line, "#fff");
  }

  /** Draws the mask of the network and all lines anew. */
  renew() {
    const context = this.mask.getContext("2d");
    context.globalCompositeOperation = "copy";
    context.drawImage(this.base, 0, 0);
    this.lines.forEach((line) => this.onMask(line));
    this.show();
  }

  show() {
    const cut = this.cut.getContext("2d");
    cut.globalCompositeOperation = "copy";
    cut.drawImage(this.picture, 0, 0);
    cut.globalCompositeOperation = "destination-in";
    cut.drawImage(this.mask, 0, 0);
    const context = this.canvas.getContext("2d");
    context.globalAlpha = 1;
    context.fillStyle = "#b03060";
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    context.globalAlpha = BEHIND;
    context.drawImage(this.picture, 0, 0);
    context.globalAlpha = 1;
    context.drawImage(this.cut, 0, 0);
    this.showJoints(context);
  }

  /** Writes notes beside parts of the body: `{ part: text }`. */
  note(notes) {
    this.notes = notes;
    if (this.picture) {
      this.show();
    }
  }

  /** Faint bones; a part with a note is brighter. */
  showJoints(context) {
    const { width, height } = this.canvas;
    const unit = Math.max(width, height) / 1024;
    const place = ([x, y]) => [x * width, y * height];
    for (const [part, bones] of Object.entries(BONES)) {
      const color = part in this.notes ? "#fc6" : "#fff";
      context.globalAlpha = part in this.notes ? 0.9 : 0.4;
      for (const ends of bones.map((bone) => bone.map((joint) => this.joints[joint]))) {
        if (ends.every((joint) => joint?.[2] > SEEN)) {
          this.line(context, { width: 4 * unit, points: ends.map(place) }, color);
        }
      }
    }
    context.globalAlpha = 1;
    context.font = `${30 * unit}px system-ui, sans-serif`;
    for (const [part, text] of Object.entries(this.notes).filter(([part]) => BONES[part] && this.joints.length)) {
      const [x, y] = place(this.joints[BONES[part][0][1]]);
      const long = Math.min(context.measureText(text).width, width);
      // On the outer side of the limb.
      const wanted = 2 * x < place(this.joints[23])[0] + place(this.joints[24])[0] ? x - 16 * unit - long : x + 16 * unit;
      const [left, top] = [Math.min(Math.max(wanted, 0), width - long), Math.min(Math.max(y, 40 * unit), height - 12 * unit)];
      Object.assign(context, { lineWidth: 6 * unit, strokeStyle: "#000", fillStyle: "#fc6" });
      context.strokeText(text, left, top, width);
      context.fillText(text, left, top, width);
    }
  }

  /** The lines as a picture for the server: white keeps, black removes, 128 changes nothing. Empty without lines. */
  async strokes() {
    if (this.lines.length === 0) {
      return new Blob([]);
    }
    const canvas = canvasOf(this.canvas.width, this.canvas.height);
    const context = canvas.getContext("2d");
    context.fillStyle = "rgb(128, 128, 128)";
    context.fillRect(0, 0, canvas.width, canvas.height);
    this.lines.forEach((line) => this.line(context, line, line.keeps ? "#fff" : "#000"));
    return new Promise((done) => canvas.toBlob(done));
  }
}
