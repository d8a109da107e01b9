for (const comparer of document.querySelectorAll(".comparer")) {
  const stages = [...comparer.querySelectorAll(".stage")];
  const buttons = [...comparer.querySelectorAll("nav button")];
  const show = (chosen) => {
    stages.forEach((stage, i) => stage.classList.toggle("on", i === chosen));
    buttons.forEach((button, i) => button.classList.toggle("on", i === chosen));
  };
  buttons.forEach((button, i) => button.addEventListener("click", () => show(i)));
  for (const input of comparer.querySelectorAll("input[type=range]")) {
    input.addEventListener("input", () => {
      // all stages move together, so that flipping through frames keeps the dividing line in place
      comparer.style.setProperty("--at", input.value + "%");
      for (const other of comparer.querySelectorAll("input[type=range]")) other.value = input.value;
    });
  }
}

for (const player of document.querySelectorAll(".player")) {
  const images = [...player.querySelectorAll("img")];
  const [button, slider, label] = ["button", "input", "output"].map((s) => player.querySelector(s));
  const show = (index) => {
    images.forEach((image, i) => image.classList.toggle("on", i === index));
    slider.value = index;
    label.textContent = images[index].alt;
  };
  let timer = 0;
  const stop = () => {
    clearInterval(timer);
    timer = 0;
    button.textContent = "Play";
  };
  button.addEventListener("click", () => {
    if (timer) return stop();
    button.textContent = "Pause";
    const next = () => show((Number(slider.value) + 1) % images.length);
    timer = setInterval(next, Number(player.dataset.interval));
  });
  slider.addEventListener("input", () => {
    stop();
    show(Number(slider.value));
  });
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (player.classList.contains("playing") && !still) button.click();
}
