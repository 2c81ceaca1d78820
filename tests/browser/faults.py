"""What a page shows wrong: broken images, mathematics that is not typeset, what does not fit."""

from playwright.sync_api import Page

from tests.browser.waiting import eventually

FAULTS = r"""async selector => {
    await window.MathJax?.startup?.promise;
    const root = document.querySelector(selector);
    const all = query => [...root.querySelectorAll(query)];
    const images = all("img");
    await Promise.allSettled(images.map(image => image.decode()));
    const source = [];
    const texts = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
    while (texts.nextNode()) {
        const {data, parentElement} = texts.currentNode;
        const verbatim = parentElement.closest("pre, code, script, style, textarea, .cm-editor");
        if (!verbatim && /\\[([]|[$]/.test(data)) source.push(data);
    }
    const wide = [document.scrollingElement, ...all(".jp-OutputArea-output")];
    return [
        ...source,
        ...[
            ...images.filter(image => !image.naturalWidth),
            ...all(".math:not(:has(mjx-container)), mjx-merror, [data-mml-node=merror]"),
            ...wide.filter(box => box.scrollWidth > box.clientWidth + 1),
        ].map(element => element.outerHTML.slice(0, 200)),
    ];
}"""


def faults(page: Page, root: str) -> list[str]:
    """What is wrong in the element `root` of a page, once it has had time to settle."""
    return eventually(page, lambda: page.evaluate(FAULTS, root), [], patience=10.0)
