// A photograph from the browser's camera.

const element = (id) => document.getElementById(id);

/** Seconds until the picture of somebody who walks in front of the camera is taken. */
const DELAY = 10;

let taking = false;

/** A picture of a side from the camera, or nothing after an error, which `say` gets, or "Cancel". */
export async function takePicture(side, say) {
  // The browser may still be asking whether the page may use the camera.
  if (taking) {
    return null;
  }
  taking = true;
  try {
    return await take(side, say);
  } finally {
    taking = false;
  }
}

async function take(side, say) {
  const dialog = element("taking");
  dialog.querySelector("h2").textContent = side;
  const video = dialog.querySelector("video");
  let stream;
  try {
    stream = await navigator.mediaDevices.getUserMedia({ video: { width: { ideal: 4096 }, height: { ideal: 2160 } } });
  } catch (error) {
    say(`No camera: ${error.message ?? error}`);
    return null;
  }
  video.srcObject = stream;
  dialog.showModal();
  const count = dialog.querySelector("output");
  let timer = 0;
  const chosen = await new Promise((done) => {
    const take = () => done(true);
    dialog.querySelector(".now").onclick = take;
    dialog.querySelector(".later").onclick = () => {
      let left = DELAY;
      count.textContent = String(left);
      clearInterval(timer);
      timer = setInterval(() => {
        left -= 1;
        count.textContent = String(left);
        if (left === 0) {
          take();
        }
      }, 1000);
    };
    dialog.querySelector(".cancel").onclick = () => done(false);
    dialog.onclose = () => done(false);
  });
  clearInterval(timer);
  count.textContent = "";
  let picture = null;
  if (chosen && video.videoWidth > 0) {
    const canvas = Object.assign(document.createElement("canvas"), { width: video.videoWidth, height: video.videoHeight });
    canvas.getContext("2d").drawImage(video, 0, 0);
    const blob = await new Promise((done) => canvas.toBlob(done, "image/jpeg", 0.95));
    picture = blob && new File([blob], "camera.jpg", { type: "image/jpeg" });
  }
  if (chosen && !picture) {
    say("The camera gave no picture.");
  }
  stream.getTracks().forEach((track) => track.stop());
  video.srcObject = null;
  dialog.close();
  return picture;
}
