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
