// Files that the page saves.

/** Milliseconds between two questions about the progress of a mesh. */
const INTERVAL = 500;

export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Saves the mesh that a link leads to. `say` gets its progress, since the server makes it on demand. */
export async function saveMesh(link, name, say) {
  if (link.classList.contains("busy")) {
    return;
  }
  link.classList.add("busy");
  const start = performance.now();
  const timer = setInterval(async () => {
    const answer = await fetch("./progress", { cache: "no-store" }).catch(() => null);
    const stage = answer?.ok ? await answer.text() : "";
    if (link.classList.contains("busy")) {
      say(`Making the mesh: ${stage || "waiting"} … ${Math.round((performance.now() - start) / 1000)} s`);
    }
  }, INTERVAL);
  say("Making the mesh …");
  let message = "";
  try {
    const answer = await fetch(link.href, { cache: "no-store" });
    if (!answer.ok) {
      throw new Error(await answer.text());
    }
    save(await answer.blob(), name);
  } catch (error) {
    message = `No mesh: ${error.message ?? error}`;
  }
  clearInterval(timer);
  link.classList.remove("busy");
  say(message);
}
