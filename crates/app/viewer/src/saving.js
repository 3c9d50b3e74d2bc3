// Files that the page saves.

import { ask } from "./asking.js";

export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Saves the file that a link leads to, which the server makes on demand. `say` gets its progress. */
export async function saveLong(link, name, say) {
  if (link.classList.contains("busy")) {
    return;
  }
  link.classList.add("busy");
  const what = link.id;
  const start = performance.now();
  const step = (step) => say(`Making the ${what}: ${step} … ${Math.round((performance.now() - start) / 1000)} s`);
  say(`Making the ${what} …`);
  let message = "";
  try {
    const answer = await ask(link.href, {}, step);
    save(await answer.blob(), name);
  } catch (error) {
    message = `No ${what}: ${error.message ?? error}`;
  }
  link.classList.remove("busy");
  say(message);
}
