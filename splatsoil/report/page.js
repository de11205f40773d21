// One slider moves every camera through its compared frames.
const cameras = JSON.parse(document.getElementById("frames").textContent);
const slider = document.getElementById("frame");

function show(index) {
  for (const figure of document.querySelectorAll("figure.camera")) {
    const frames = cameras[figure.dataset.camera].frames;
    const entry = frames[Math.min(index, frames.length - 1)];
    for (const image of figure.querySelectorAll("img")) image.src = entry[image.dataset.kind];
    figure.querySelector(".frame").textContent = entry.frame;
    figure.querySelector(".loss").textContent = entry.loss;
  }
}

slider.addEventListener("input", () => show(Number(slider.value)));
