const attempts = [...document.querySelectorAll(".attempt-page")];
const tabs = [...document.querySelectorAll(".tabs button")];
let attempt = 0, step = 0;

function clamp(value, count) { return Math.max(0, Math.min(count - 1, value)); }
function show(next_attempt, next_step) {
  attempt = clamp(next_attempt, attempts.length);
  const page = attempts[attempt];
  const chips = [...page.querySelectorAll(".chip")];
  step = clamp(next_step, chips.length);
  attempts.forEach((other) => { other.hidden = other !== page; });
  tabs.forEach((tab, i) => tab.setAttribute("aria-selected", i === attempt));
  chips.forEach((chip, i) => chip.classList.toggle("lit", i === step));
  page.querySelectorAll(".step-page").forEach((other, i) => { other.hidden = i !== step; });
  page.querySelectorAll(".map .stop").forEach((stop, i) => stop.classList.toggle("lit", i === step));
  if (chips[step]) chips[step].scrollIntoView({ block: "nearest", inline: "nearest" });
  history.replaceState(null, "", `#${attempt}.${step + 1}`);
}
function from_address() {
  const [first, second] = location.hash.slice(1).split(".").map(Number);
  show(first || 0, (second || 1) - 1);
}
tabs.forEach((tab, i) => tab.addEventListener("click", () => show(i, step)));
for (const [i, page] of attempts.entries()) {
  page.querySelectorAll(".chip").forEach((chip, k) => chip.addEventListener("click", () => show(i, k)));
  page.querySelectorAll(".map .stop").forEach((stop, k) => stop.addEventListener("click", () => show(i, k)));
}
addEventListener("hashchange", from_address);
addEventListener("keydown", (event) => {
  if (event.altKey || event.ctrlKey || event.metaKey) return;
  if (event.key === "ArrowRight") show(attempt, step + 1);
  else if (event.key === "ArrowLeft") show(attempt, step - 1);
  else if (/^[1-9]$/.test(event.key) && event.key <= tabs.length) show(event.key - 1, step);
  else return;
  event.preventDefault();
});
from_address();
