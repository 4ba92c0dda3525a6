"use strict";
const root = document.documentElement;
document.getElementById("theme").addEventListener("click", () => {
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
});
for (const button of document.querySelectorAll("button.all")) {
  button.addEventListener("click", () => {
    const steps = [...button.closest(".attempt").querySelectorAll(".step")];
    const open = !steps.every((step) => step.open);
    steps.forEach((step) => { step.open = open; });
    button.textContent = open ? "Close all decisions" : "Open all decisions";
  });
}
// A decision and its place on the map light up together; a click on the place opens the decision.
for (const stop of document.querySelectorAll(".stop")) {
  const step = document.getElementById("step-" + stop.dataset.step);
  step.addEventListener("mouseenter", () => stop.classList.add("lit"));
  step.addEventListener("mouseleave", () => stop.classList.remove("lit"));
  stop.addEventListener("click", () => { step.open = true; step.scrollIntoView({ block: "center" }); });
}
