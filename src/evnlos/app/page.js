// The slider and the play button of a sheet. All positions are in the page: nothing is asked of the server.
(() => {
  let kept = null, timer = null;
  const show = (sheet, k) => {
    sheet.style.setProperty("--k", k);
    for (const text of sheet.querySelectorAll("[data-texts]"))
      text.textContent = JSON.parse(text.dataset.texts)[k];
  };
  const stop = () => {
    clearInterval(timer);
    timer = null;
    for (const button of document.querySelectorAll(".ev-play")) {
      button.textContent = "Play";
      button.setAttribute("aria-pressed", "false");
    }
  };
  window.evnlosMove = (slider) => {
    stop();
    kept = slider.value;
    show(slider.closest(".ev-sheet"), slider.value);
  };
  const step = () => {
    for (const sheet of document.querySelectorAll(".ev-sheet")) {
      if (!sheet.offsetParent) continue;
      const slider = sheet.querySelector(".ev-position");
      slider.value = Number(slider.value) < Number(slider.max) ? Number(slider.value) + 1 : 0;
      kept = slider.value;
      show(sheet, slider.value);
    }
  };
  window.evnlosPlay = (button) => {
    if (timer) return stop();
    button.textContent = "Pause";
    button.setAttribute("aria-pressed", "true");
    timer = setInterval(step, 120);
  };
  // Where a sequence replaces another one, Gradio changes the page in place: the mark of the sequence tells.
  // A new sequence stays at the position that was looked at, and goes on where one was playing.
  const arrived = (sheet) => {
    performance.mark("evnlos-sheet");
    const slider = sheet.querySelector(".ev-position"), button = sheet.querySelector(".ev-play");
    if (kept !== null && Number(kept) <= Number(slider.max)) slider.value = kept;
    show(sheet, slider.value);
    if (timer) {
      button.textContent = "Pause";
      button.setAttribute("aria-pressed", "true");
    }
  };
  new MutationObserver((changes) => {
    for (const change of changes) {
      if (change.type === "attributes") arrived(change.target);
      for (const node of change.addedNodes)
        if (node.nodeType === 1)
          for (const sheet of node.matches(".ev-sheet") ? [node] : node.querySelectorAll(".ev-sheet")) arrived(sheet);
    }
  }).observe(document, { childList: true, subtree: true, attributes: true, attributeFilter: ["data-sequence"] });

  // The address of the settings: copied, or opened where the browser lets no page copy.
  window.evnlosShare = (link) => {
    if (!navigator.clipboard) return true;
    navigator.clipboard.writeText(link.href).then(() => {
      link.textContent = "Copied";
      setTimeout(() => { link.textContent = "Copy link"; }, 2000);
    });
    return false;
  };
  // All images at the position that is looked at, with their titles, as one PNG.
  window.evnlosSave = async (button) => {
    const sheet = button.closest(".ev-sheet"), k = Number(sheet.style.getPropertyValue("--k"));
    const figures = [...sheet.querySelectorAll("figure:not(.ev-setup)")], WIDTH = 320, ROW = 260, COLUMNS = 4;
    const canvas = document.createElement("canvas"), ink = canvas.getContext("2d");
    canvas.width = WIDTH * COLUMNS;
    canvas.height = ROW * Math.ceil(figures.length / COLUMNS);
    ink.fillStyle = "#fff";
    ink.fillRect(0, 0, canvas.width, canvas.height);
    for (const [i, figure] of figures.entries()) {
      const picture = figure.querySelector(".ev-image"), box = picture.getBoundingClientRect(), image = new Image();
      image.src = picture.style.backgroundImage.slice(5, -2);
      await image.decode();
      const many = picture.style.backgroundSize.includes("var"), count = many ? Number(sheet.style.getPropertyValue("--n")) : 1;
      const height = image.height / count, x = (i % COLUMNS) * WIDTH, y = Math.floor(i / COLUMNS) * ROW;
      const zoom = Math.min((WIDTH - 16) / box.width, (ROW - 50) / box.height);
      ink.fillStyle = "#222";
      ink.font = "14px sans-serif";
      ink.fillText(figure.querySelector("figcaption").innerText.replaceAll("\n", "  "), x + 8, y + 20, WIDTH - 16);
      ink.imageSmoothingEnabled = false;
      ink.drawImage(image, 0, many ? k * height : 0, image.width, height, x + 8, y + 30, box.width * zoom, box.height * zoom);
    }
    const link = document.createElement("a");
    link.download = "evnlos.png";
    link.href = canvas.toDataURL("image/png");
    link.click();
    return link.href.length;
  };

  // A number typed beside a slider keeps to the slider's ends.
  document.addEventListener("change", (event) => {
    const box = event.target, range = box.closest?.(".block")?.querySelector("input[type=range]");
    if (box.type !== "number" || !range || box.value === "") return;
    const kept = Math.min(Math.max(Number(box.value), Number(range.min)), Number(range.max));
    if (kept === Number(box.value)) return;
    box.value = kept;
    box.dispatchEvent(new Event("input", { bubbles: true }));
  });

  // Drawing: strokes on a canvas; what is sent is its ink on 32 x 32 pixels, as hexadecimal digits.
  const SIDE = 32, WIDTH = 18, STEP = 6;
  const nib = { x: 96, y: 96, down: false };
  const place = (canvas, event) => {
    const box = canvas.getBoundingClientRect();
    return [((event.clientX - box.left) * canvas.width) / box.width, ((event.clientY - box.top) * canvas.height) / box.height];
  };
  const moved = (canvas, x, y, draws) => {
    const ink = canvas.getContext("2d");
    if (draws) {
      Object.assign(ink, { lineWidth: WIDTH, lineCap: "round", strokeStyle: "#e27800" });
      ink.beginPath();
      ink.moveTo(nib.x, nib.y);
      ink.lineTo(x, y);
      ink.stroke();
    }
    [nib.x, nib.y] = [x, y];
    const mark = canvas.parentElement.querySelector(".ev-nib");
    mark.style.left = `${canvas.offsetLeft + (x * canvas.offsetWidth) / canvas.width}px`;
    mark.style.top = `${canvas.offsetTop + (y * canvas.offsetHeight) / canvas.height}px`;
  };
  const send = (canvas) => {
    const small = document.createElement("canvas");
    small.width = small.height = SIDE;
    const ink = small.getContext("2d");
    ink.imageSmoothingQuality = "high";
    ink.drawImage(canvas, 0, 0, SIDE, SIDE);
    const values = ink.getImageData(0, 0, SIDE, SIDE).data.filter((_, i) => i % 4 === 3);
    const text = document.querySelector("#ev-ink textarea, #ev-ink input");
    text.value = [...values].map((value) => value.toString(16).padStart(2, "0")).join("");
    text.dispatchEvent(new Event("input", { bubbles: true }));
  };
  const penOf = (event) => (event.target.matches?.(".ev-pen") ? event.target : null);
  document.addEventListener("pointerdown", (event) => {
    const canvas = penOf(event);
    if (!canvas) return;
    canvas.setPointerCapture(event.pointerId);
    nib.down = true;
    [nib.x, nib.y] = place(canvas, event);
    moved(canvas, nib.x, nib.y, true);
  });
  document.addEventListener("pointermove", (event) => {
    const canvas = penOf(event);
    if (canvas && nib.down) moved(canvas, ...place(canvas, event), true);
  });
  document.addEventListener("pointerup", (event) => {
    const canvas = penOf(event);
    if (canvas && nib.down) send(canvas);
    nib.down = false;
  });
  const WAYS = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, -STEP], ArrowDown: [0, STEP] };
  document.addEventListener("keydown", (event) => {
    const canvas = penOf(event), way = WAYS[event.key];
    if (!canvas || !way) return;
    event.preventDefault();
    const kept = (value, most) => Math.min(Math.max(value, 0), most);
    moved(canvas, kept(nib.x + way[0], canvas.width), kept(nib.y + way[1], canvas.height), event.shiftKey);
    if (event.shiftKey) send(canvas);
  });
  window.evnlosClear = (button) => {
    const canvas = button.parentElement.querySelector(".ev-pen");
    canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
    send(canvas);
  };
})();
