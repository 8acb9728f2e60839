"""Join the films of `python -m lorasp_jax.extras.judge ... --films FOLDER` as one animation.

    python studies/metaworld/films.py FOLDER

The tasks are in alphabetical order, row by row. A film that ends earlier shows its last picture.
"""

import argparse
from pathlib import Path

from PIL import Image, ImageDraw, ImageSequence

COLUMNS, CAPTION, GAP = 5, 14, 4
"""Films per row, caption height and space between films [pixels]."""
INK, PAPER = (110, 118, 129), (255, 255, 255, 0)
"""Gray text, legible on light and dark pages, and a transparent background."""
FRAME_MS, HOLD = 100, 10
"""Time per picture [ms], and how many times the last one is shown."""


def main() -> None:
    """Write the animation requested on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the films")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("films.webp"))
    parser.add_argument("--quality", type=int, default=40, help="WebP quality, 0 to 100")
    options = parser.parse_args()
    films = {path.stem: pictures(path) for path in sorted(options.folder.glob("*.webp"))}
    count = max(map(len, films.values())) + HOLD
    options.out.parent.mkdir(parents=True, exist_ok=True)
    first, *rest = (frame(films, i) for i in range(count))
    save = {"save_all": True, "append_images": rest, "duration": FRAME_MS, "loop": 0}
    first.save(options.out, quality=options.quality, method=6, **save)


def pictures(path: Path) -> list[Image.Image]:
    """Return the pictures of a film."""
    with Image.open(path) as film:
        return [picture.convert("RGB") for picture in ImageSequence.Iterator(film)]


def frame(films: dict[str, list[Image.Image]], i: int) -> Image.Image:
    """Draw the i-th picture of all films, with their names."""
    width, height = next(iter(films.values()))[0].size
    rows = -(-len(films) // COLUMNS)
    size = COLUMNS * (width + GAP) - GAP, rows * (height + CAPTION + GAP) - GAP
    canvas = Image.new("RGBA", size, PAPER)
    draw = ImageDraw.Draw(canvas)
    for n, (name, film) in enumerate(films.items()):
        x, y = n % COLUMNS * (width + GAP), n // COLUMNS * (height + CAPTION + GAP)
        draw.text((x, y), name, fill=INK)
        canvas.paste(film[min(i, len(film) - 1)], (x, y + CAPTION))
    return canvas


if __name__ == "__main__":
    main()
