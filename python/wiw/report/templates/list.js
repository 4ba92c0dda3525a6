const form = document.getElementById("filters");
const rows = [...document.querySelectorAll(".list tbody tr")].map((row) => (
  { row, scene: row.dataset.scene, states: row.dataset.states.split(" "), pictures: row.dataset.pictures === "1" }));
const fields = ["scene", "arm", "state", "won", "lost"].filter((name) => form.elements[name]);

function fits(line, wanted) {
  const of_arm = wanted.arm === "" || wanted.arm === undefined ? line.states : [line.states[wanted.arm]];
  return (!wanted.scene || line.scene === wanted.scene)
    && (!wanted.state || of_arm.includes(wanted.state))
    && (!wanted.won || line.states[wanted.won] === "success")
    && (!wanted.lost || line.states[wanted.lost] === "failure")
    && (!form.elements.pictures.checked || line.pictures);
}
function show() {
  const wanted = Object.fromEntries(fields.map((name) => [name, form.elements[name].value]));
  let count = 0;
  for (const line of rows) {
    line.row.hidden = !fits(line, wanted);
    count += !line.row.hidden;
  }
  document.getElementById("count").textContent = `${count} of ${rows.length}`;
  document.querySelectorAll(".list .arm").forEach((head, i) => {
    const shown = rows.filter((line) => !line.row.hidden).map((line) => line.states[i]);
    const successes = shown.filter((state) => state === "success").length;
    const scored = shown.filter((state) => state === "success" || state === "failure").length;
    head.classList.toggle("lit", wanted.arm === String(i));
    head.querySelector("small").textContent = `${successes} of ${scored}`;
  });
  const said = new URLSearchParams(Object.entries(wanted).filter(([, value]) => value));
  if (form.elements.pictures.checked) said.set("pictures", "1");
  history.replaceState(null, "", "#" + said);
}
function from_address() {
  const said = new URLSearchParams(location.hash.slice(1));
  for (const name of fields) form.elements[name].value = said.get(name) ?? "";
  form.elements.pictures.checked = said.has("pictures");
  show();
}
form.addEventListener("input", show);
form.addEventListener("submit", (event) => event.preventDefault());
form.addEventListener("reset", () => setTimeout(show));
addEventListener("hashchange", from_address);
for (const line of rows) {
  const link = line.row.querySelector("a");
  if (link) line.row.addEventListener("click", (event) => { if (event.target !== link) location.href = link.href; });
  line.row.classList.toggle("linked", Boolean(link));
}
from_address();
