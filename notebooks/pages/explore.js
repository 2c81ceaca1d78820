// Beside a slider a number is read at Enter only, and 1,5 as 1: be it read as 1.5, and when it is left.
const enter = {key: "Enter", keyCode: 13, bubbles: true};
for (const kind of ["keydown", "blur"]) document.addEventListener(kind, event => {
    const box = event.target;
    if (!box.matches?.(".robsmooth-explorer .widget-readout")) return;
    if (kind === "blur") box.dispatchEvent(new KeyboardEvent("keydown", enter));
    else if (event.key === "Enter") box.textContent = box.textContent.replace(",", ".");
}, true);
