// The first pictures at once: Gradio needs seconds for its controls, but what it will show is in the page already.
(() => {
  const parts = window.gradio_config?.components ?? [];
  const content = (id) => parts.find((part) => part.props?.elem_id === id)?.props.value ?? "";
  if (!content("ev-opening")) return;
  const box = document.createElement("div"), style = document.createElement("style");
  box.className = "ev-before";
  box.innerHTML = `${content("ev-about")}<main><p role="status">The controls are on their way.</p><div>${content("ev-opening")}</div></main>`;
  style.textContent = window.gradio_config.css;
  document.head.append(style);
  document.body.append(box);
  new MutationObserver((_, watch) => {
    if (!document.querySelector("gradio-app .ev-sheet")) return;
    watch.disconnect();
    box.remove();
    style.remove();
  }).observe(document.querySelector("gradio-app"), { childList: true, subtree: true });
})();
