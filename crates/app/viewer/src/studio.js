// The studio: two photographs, their masks, and the person that the server makes of them.

import { ask } from "./asking.js";
import { Drawing } from "./masks.js";
import { takePicture } from "./taking.js";

const element = (id) => document.getElementById(id);

/** Largest photograph in bytes, as the server knows it. */
const LARGEST = 128 * 2 ** 20;

/** What stands beside parts of the body. */
const notesOf = (signs) => Object.fromEntries(signs.flatMap(({ note, parts }) => parts.map((part) => [part, note])));

/** One of the two photographs: a place for a file, then the picture with its mask. */
class Photograph {
  constructor(side, changed) {
    this.root = element("photograph").content.cloneNode(true).firstElementChild;
    this.call(side);
    this.changed = changed;
    this.file = null;
    this.signs = [];
    this.asked = 0;
    this.drawing = new Drawing(this.root.querySelector("canvas"), (strokes) => this.drawn(strokes));
    const part = (selector) => this.root.querySelector(selector);
    for (const input of this.root.querySelectorAll("input[type=file]")) {
      input.addEventListener("change", () => {
        this.use(input.files[0]);
        // The same file may be chosen again.
        input.value = "";
      });
    }
    for (const kind of ["dragover", "dragleave", "drop"]) {
      this.root.addEventListener(kind, (event) => {
        event.preventDefault();
        this.root.classList.toggle("over", kind === "dragover");
      });
    }
    this.root.addEventListener("drop", (event) => {
      event.stopPropagation();
      this.use(event.dataTransfer.files[0]);
    });
    // A telephone has a camera program of its own.
    const isTouched = matchMedia("(pointer: coarse)").matches;
    part(".shoot").classList.toggle("hidden", !isTouched);
    part(".camera").classList.toggle("hidden", isTouched || !navigator.mediaDevices?.getUserMedia);
    part(".camera").addEventListener("click", () => this.take());
    part(".other").addEventListener("click", () => this.clear());
    part(".undo").addEventListener("click", () => this.drawing.undo());
    part(".redo").addEventListener("click", () => this.drawing.redo());
    for (const brush of this.root.querySelectorAll(".brush")) {
      brush.addEventListener("click", () => this.choose(brush));
    }
    const width = part(".width");
    width.addEventListener("input", () => this.drawing.setWidth(Number(width.value)));
    const zoom = part(".zoom");
    zoom.addEventListener("input", () => this.drawing.zoom(zoom.value));
    this.choose(part(".brush"));
  }

  /** Makes it the front or the back. */
  call(side) {
    this.root.dataset.side = side.toLowerCase();
    this.root.querySelector("h2").textContent = side;
    this.root.setAttribute("aria-label", `${side} photograph`);
    this.root.querySelector("canvas").setAttribute("aria-label", `${side} photograph; paint to correct what belongs to the person`);
    element("pair").append(this.root);
  }

  /** Takes a picture, and then the other side's if it is missing. */
  async take() {
    const side = this.root.querySelector("h2").textContent;
    const picture = await takePicture(side, (text) => this.say(text));
    if (picture) {
      this.use(picture);
      const other = this.other();
      if (!other.file && !other.busy) {
        other.take();
      }
    }
  }

  choose(brush) {
    for (const other of this.root.querySelectorAll(".brush")) {
      other.setAttribute("aria-pressed", other === brush);
    }
    this.drawing.keeps = brush.dataset.keeps === "true";
  }

  drawn(strokes) {
    this.root.querySelector(".undo").disabled = strokes.lines.length === 0;
    this.root.querySelector(".redo").disabled = strokes.undone.length === 0;
  }

  get busy() {
    return this.root.classList.contains("busy");
  }

  say(text) {
    this.root.querySelector(".message").textContent = text;
  }

  /** Whether its mask is shown. */
  get ready() {
    return this.root.classList.contains("cut");
  }

  clear() {
    this.asked += 1;
    this.file = null;
    this.signs = [];
    this.drawing.clear();
    this.root.classList.remove("cut", "busy");
    this.say("");
    this.changed();
  }

  /** Shows a file's picture with the mask that the server finds. */
  async use(file) {
    if (!file) {
      return;
    }
    this.clear();
    if (file.size > LARGEST) {
      this.say(`${file.name} has ${Math.ceil(file.size / 2 ** 20)} MB; photographs may have up to ${LARGEST / 2 ** 20}.`);
      return;
    }
    const own = this.asked;
    this.root.classList.add("busy");
    this.say("removing the background …");
    try {
      const answer = await ask("./cutout", { method: "POST", body: file }, (step) => own === this.asked && this.say(`${step} …`));
      const [picture, mask] = answer.headers.get("x-parts").split(",").map(Number);
      const bytes = await answer.blob();
      const parts = [bytes.slice(0, picture), bytes.slice(picture, picture + mask)];
      const pictures = await Promise.all(parts.map((part) => createImageBitmap(part)));
      const seen = JSON.parse(await bytes.slice(picture + mask).text());
      if (own === this.asked) {
        this.file = file;
        this.signs = seen.signs;
        this.drawing.open(...pictures, seen.joints);
        this.root.classList.add("cut");
        this.say(seen.signs.map((sign) => sign.text).join("; "));
      }
    } catch (error) {
      if (own === this.asked) {
        this.say(error.message ?? String(error));
      }
    }
    if (own === this.asked) {
      this.root.classList.remove("busy");
      this.changed();
    }
  }
}

/** Starts the studio. `show` gets the name of a new person in the server's addresses. */
export function openStudio(show) {
  const make = element("make");
  let working = false;
  const changed = () => {
    make.disabled = working || !photographs.every((photograph) => photograph.ready);
  };
  const exchanged = () => {
    photographs.forEach((photograph) => photograph.drawing.note(notesOf(photograph.signs)));
    element("warnings").replaceChildren();
    changed();
  };
  const sides = ["Front", "Back"];
  const photographs = sides.map((side) => new Photograph(side, () => exchanged()));
  photographs.forEach((photograph) => {
    photograph.other = () => photographs.find((other) => other !== photograph);
  });
  changed();
  element("swap").addEventListener("click", () => {
    photographs.reverse().forEach((photograph, i) => photograph.call(sides[i]));
    exchanged();
  });
  let painted = photographs[0];
  photographs.forEach((photograph) => {
    photograph.root.addEventListener("pointerdown", () => {
      painted = photograph;
    });
  });
  window.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase();
    const isOpen = document.body.classList.contains("making") && event.target.tagName !== "INPUT";
    if (isOpen && (event.ctrlKey || event.metaKey) && ["z", "y"].includes(key)) {
      event.preventDefault();
      if (key === "y" || event.shiftKey) {
        painted.drawing.redo();
      } else {
        painted.drawing.undo();
      }
    }
  });
  // A reload would lose them.
  window.addEventListener("beforeunload", (event) => {
    if (photographs.some(({ file }) => file)) {
      event.preventDefault();
    }
  });
  const say = (text) => {
    element("work").textContent = text;
  };

  const enter = (open) => {
    element("studio").classList.toggle("hidden", !open);
    document.body.classList.toggle("making", open);
  };
  element("photographs").addEventListener("click", () => enter(true));
  element("again").addEventListener("click", () => {
    photographs.forEach((photograph) => photograph.clear());
    say("");
  });

  // Whoever starts again meanwhile does not want the former person.
  let started = 0;
  element("again").addEventListener("click", () => {
    started += 1;
  });
  make.addEventListener("click", async () => {
    const own = started;
    const isWanted = () => own === started;
    working = true;
    changed();
    try {
      const files = photographs.map((photograph) => photograph.file);
      const strokes = await Promise.all(photographs.map((photograph) => photograph.drawing.strokes()));
      const parts = [...files, ...strokes];
      const told = Object.fromEntries(["height", "focal"].map((name) => [name, element(name).value]).filter(([, value]) => value));
      const headers = { "X-Parts": parts.map((part) => part.size).join(","), "X-Told": JSON.stringify(told) };
      const start = performance.now();
      const step = (name) => isWanted() && say(`${name} … ${Math.round((performance.now() - start) / 1000)} s`);
      step("sending");
      const answer = await ask("./reconstruct", { method: "POST", headers, body: new Blob(parts) }, step);
      const person = await answer.json();
      if (isWanted()) {
        for (const photograph of photographs.filter(({ file }, i) => file === files[i])) {
          const about = person.warnings.filter(({ of }) => of.includes(`${photograph.root.dataset.side} photograph`));
          photograph.drawing.note(notesOf(about));
        }
        const warnings = person.warnings.map(({ text }) => {
          const item = document.createElement("li");
          item.textContent = text;
          return item;
        });
        element("warnings").replaceChildren(...warnings);
        say(`${person.gaussians.toLocaleString("en")} Gaussians in ${person.seconds.toFixed(1)} s`);
        await show(person.name);
        // Warnings are read before the person is looked at.
        enter(warnings.length > 0);
        element("look").classList.remove("hidden");
      }
    } catch (error) {
      if (isWanted()) {
        say(error.message ?? String(error));
      }
    }
    working = false;
    changed();
  });
  element("look").addEventListener("click", () => enter(false));
  enter(true);
}
