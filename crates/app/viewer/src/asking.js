// Requests whose work takes the server seconds.

/** Milliseconds between two questions about progress. */
const INTERVAL = 300;

/** Fetches without caches. Browsers only say "Failed to fetch" if the server ended or a chosen file changed. */
export async function fetched(path, options) {
  const answer = await fetch(path, { ...options, cache: "no-store" }).catch(() => {
    throw new Error("the program has ended, or the file has changed since it was chosen: choose it again");
  });
  if (!answer.ok) {
    throw new Error(await answer.text());
  }
  return answer;
}

/** Sends a request, and calls `step` with the name of each step of the server's work for it. */
export async function ask(path, options, step) {
  // `randomUUID` is missing where the page comes from another device.
  const job = crypto.getRandomValues(new Uint32Array(4)).join("-");
  const headers = { ...options.headers, "X-Job": job };
  let open = true;
  const timer = setInterval(async () => {
    const answer = await fetch("./progress", { headers: { "X-Job": job }, cache: "no-store" }).catch(() => null);
    const name = answer?.ok ? await answer.text() : "";
    // An answer may arrive after the work's end.
    if (open && name) {
      step(name);
    }
  }, INTERVAL);
  try {
    return await fetched(path, { ...options, headers });
  } finally {
    open = false;
    clearInterval(timer);
  }
}
