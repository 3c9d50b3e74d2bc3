// The address by which another device opens this page.

import { fetched } from "./asking.js";

const element = (id) => document.getElementById(id);

/** Offers the address if the program serves the local network and this browser is on its machine. */
export function openLan() {
  const dialog = element("lan");
  element("telephone").classList.toggle("hidden", !document.documentElement.classList.contains("inviting"));
  element("telephone").addEventListener("click", async () => {
    try {
      const { address, picture } = await (await fetched("./invitation")).json();
      dialog.querySelector("img").src = `data:image/svg+xml,${encodeURIComponent(picture)}`;
      dialog.querySelector("output").textContent = address;
      dialog.showModal();
    } catch (error) {
      element("work").textContent = error.message ?? String(error);
    }
  });
  dialog.querySelector("button").addEventListener("click", () => dialog.close());
}
