"""The panels of explore.ipynb: pictures, and the controls beside them."""

from playwright.sync_api import Page, expect

# A picture that is replaced while it is looked at is gone: then the next one is taken.
DIGEST = """async images => {
    const digests = [];
    for (const image of images) for (let tries = 1; ; tries++) {
        try {
            await image.decode();
            const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
            const context = canvas.getContext("2d");
            context.drawImage(image, 0, 0);  // to fetch it again could be too late
            const pixels = context.getImageData(0, 0, canvas.width, canvas.height).data;
            digests.push(new Uint8Array(await crypto.subtle.digest("SHA-256", pixels)).join());
            break;
        } catch (error) {
            if (tries === 10) throw error;
        }
    }
    return digests.join();
}"""
WATCH = """image => {
    let pressed = null;
    window.delay = null;
    document.addEventListener("keydown", () => { pressed = performance.now(); }, {once: true});
    image.onload = () => {
        if (pressed !== null) window.delay ??= performance.now() - pressed;
    };
}"""
PLACE = """image => {
    const whole = image.closest(".robsmooth-explorer").getBoundingClientRect();
    const place = image.getBoundingClientRect();
    return [place.x - whole.x, place.y - whole.y, place.width, place.height];
}"""


class Panels:
    """The explorer on a page where its cell has been run."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.images = page.locator(".robsmooth-panels img")
        self.verdict = page.locator(".robsmooth-verdict")
        self.code = page.locator(".robsmooth-code textarea")
        expect(self.images).to_have_count(4)
        expect(self.images.first).to_be_visible()
        self.wait()
        self.scroll()

    def wait(self) -> None:
        """Wait until all designs are compared."""
        expect(self.verdict).not_to_contain_text("being compared")

    def scroll(self) -> None:
        """Bring all of it into sight."""
        self.page.locator(".robsmooth-explorer").evaluate("whole => whole.scrollIntoView()")

    def picture(self) -> str:
        """A digest of the pictures."""
        return self.images.evaluate_all(DIGEST)

    def place(self) -> list[float]:
        """Where in the explorer the first picture is, and how large."""
        return self.images.first.evaluate(PLACE)

    def press(self, control: str, key: str) -> float:
        """Press a key on a control, and wait for all pictures: it took so many ms."""
        self.images.last.evaluate(WATCH)  # the last to be drawn
        self.page.locator(control).press(key)
        return self.page.wait_for_function("() => window.delay").json_value()
