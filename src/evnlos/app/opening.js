// The first images at once: Gradio needs seconds for its controls, but what it will show is in the page already.
(() => {
  const WAIT_MS = 30000;
  const parts = window.gradio_config?.components ?? [];
  const content = (id) => parts.find((part) => part.props?.elem_id === id)?.props.value ?? "";
  if (!content("ev-opening")) return;
  const box = document.createElement("div"), style = document.createElement("style");
  const theme = new URLSearchParams(location.search).get("__theme");
  const dark = theme ? theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  box.className = dark ? "ev-before ev-night" : "ev-before";
  box.innerHTML = `${content("ev-about")}<main><p role="status">The controls are on their way.</p><div>${content("ev-opening")}</div></main>`;
  style.textContent = window.gradio_config.css;
  document.head.append(style);
  document.body.append(box);
  const late = setTimeout(() => {
    box.querySelector("[role=status]").textContent = "The controls have not come. Is evnlos app still running? Then load this page again.";
  }, WAIT_MS);
  new MutationObserver((_, watch) => {
    const sheet = document.querySelector("gradio-app .ev-sheet");
    if (!sheet) return;
    watch.disconnect();
    clearTimeout(late);
    const held = box.contains(document.activeElement) ? document.activeElement.classList[0] : null;
    box.remove();
    style.remove();
    if (held) sheet.querySelector(`.${held}`)?.focus();
  }).observe(document.querySelector("gradio-app"), { childList: true, subtree: true });
})();
