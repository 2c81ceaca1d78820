"""What a page shows wrong in any fonts: broken images, raw mathematics, what does not fit."""

from collections.abc import Iterator

from playwright.sync_api import Page

from tests.interface.browser.waiting import eventually

# Narrow and wide fonts, whatever a machine has: letters that are set closer together or apart.
# MathJax follows the height of the letters around, and fonts differ in it, too.
TEXT = "body :not(mjx-container, mjx-container *)"
FONTS = {
    "narrow": f"{TEXT} {{ letter-spacing: -0.05em !important; }}",
    "wide": f"""
        {TEXT}, mjx-assistive-mml * {{
            font-family: monospace, monospace !important; letter-spacing: 0.1em !important;
        }}
        mjx-container {{ font-size: 140% !important; }}""",
    "installed": "",
}
USE = """css => {
    const sheet = document.getElementById("fonts") ?? document.createElement("style");
    sheet.id = "fonts";
    sheet.textContent = css;
    document.head.append(sheet);
}"""

RAW = r"""async selector => {
    await window.MathJax?.startup?.promise;
    const texts = document.createTreeWalker(
        document.querySelector(selector), NodeFilter.SHOW_TEXT
    );
    const raw = [];
    while (texts.nextNode()) {
        const {data, parentElement} = texts.currentNode;
        const verbatim = parentElement.closest("pre, code, script, style, textarea, .cm-editor");
        if (!verbatim && /\\[([]|[$]/.test(data)) raw.push(data);
    }
    return raw;
}"""
WRONG = """async selector => {
    const root = document.querySelector(selector);
    const all = query => [...root.querySelectorAll(query)];
    const images = all("img");
    await Promise.allSettled(images.map(image => image.decode()));
    const wide = box => box.scrollWidth > box.clientWidth + 1;
    // JupyterLab scrolls what is LaTeX and nothing else.
    const output = ".jp-OutputArea-output:not(.jp-RenderedLatex)";
    const boxes = all(`.content, ${output}, .widget-box`);
    // Within them a box may scroll what is wide, and must not cut it off. Beside the formulas that
    // are seen there are others for screen readers: for them alone no box is to scroll.
    const inner = all(".content *, .jp-OutputArea-output *").filter(
        box => wide(box) && !box.closest("mjx-container")
    );
    const overflow = (box, ...kinds) => kinds.includes(getComputedStyle(box).overflowX);
    const right = element => element.getBoundingClientRect().right;
    const unseen = box => {
        const beyond = [...box.querySelectorAll("*")].filter(it => right(it) > right(box) + 1);
        return beyond.length > 0 && beyond.every(it => it.closest("mjx-assistive-mml"));
    };
    return [
        ...images.filter(image => !image.naturalWidth),
        ...all(".math:not(:has(mjx-container)), mjx-merror, [data-mml-node=merror]"),
        ...[document.scrollingElement, ...boxes].filter(wide),
        ...inner.filter(box => overflow(box, "hidden", "clip") && !unseen(box)),
        ...inner.filter(box => overflow(box, "auto", "scroll") && unseen(box)),
    ].map(element => element.outerHTML.slice(0, 200));
}"""


def in_each_font(page: Page) -> Iterator[str]:
    """Show the page in narrow fonts, in wide ones, and in those of the machine, by these names."""
    for name, css in FONTS.items():
        page.evaluate(USE, css)
        yield name


def faults(page: Page, root: str) -> list[str]:
    """What is wrong in the element `root` of a page, once its mathematics is typeset."""
    raw = eventually(page, lambda: page.evaluate(RAW, root), [])
    return raw + page.evaluate(WRONG, root)
