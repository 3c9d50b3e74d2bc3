// Keys of the page. index.html lists them.

/** Angle of a turn in radians, share of the picture of a shift, and factor of the distance, for each stroke. */
const ANGLE = (5 * Math.PI) / 180;
const SHARE = 0.05;
const CLOSER = 0.9;

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** Calls the page's actions by keys, unless a field or a menu has the focus or the studio is open. */
export function listen(page) {
  const keys = {
    "+": () => page.zoom(CLOSER),
    "=": () => page.zoom(CLOSER),
    "-": () => page.zoom(1 / CLOSER),
    1: () => page.lookFrom(0),
    2: () => page.lookFrom(90),
    3: () => page.lookFrom(180),
    4: () => page.lookFrom(270),
    r: page.rotate,
    u: page.turnOver,
    s: page.saveScreenshot,
    c: page.saveCamera,
    "?": page.help,
  };
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || ["INPUT", "SELECT"].includes(event.target.tagName)) {
      return;
    }
    if (document.body.classList.contains("making")) {
      return;
    }
    const arrow = ARROWS[event.key];
    const key = keys[event.key.toLowerCase()];
    if (arrow) {
      // The camera moves in the direction of the arrow.
      const [x, y] = arrow;
      if (event.shiftKey) {
        page.shift(SHARE * x, SHARE * y);
      } else {
        page.turn(ANGLE * x, ANGLE * y);
      }
    } else if (key) {
      key();
    } else {
      return;
    }
    event.preventDefault();
  });
}
