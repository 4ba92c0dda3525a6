// Imagined and true views of a decision after as many poses as its slider says; the pose lights up in the plans.
for (const slider of document.querySelectorAll(".scrub input")) {
  const scrub = slider.closest(".scrub"), joint = scrub.nextElementSibling;
  slider.addEventListener("input", () => {
    scrub.querySelector("output").textContent = slider.value;
    joint.querySelectorAll(".future").forEach((image) => { image.style.setProperty("--k", slider.value - 1); });
    joint.querySelectorAll(".pose").forEach((pose) => pose.classList.toggle("lit", pose.dataset.pose === slider.value));
  });
}
