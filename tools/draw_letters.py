"""Draw the letters of the usual prior, which come with the package; a row a writer.

python tools/draw_letters.py        # src/evnlos/inverse/letters.png
"""

from dataclasses import replace

import numpy as np
from PIL import Image

from evnlos.inverse.prior import LETTER_PX, LETTERS, LETTERS_FILE


def main() -> None:
    """Write the sheet."""
    glyphs = replace(LETTERS, target_plane=replace(LETTERS.target_plane, size_px=LETTER_PX))
    drawn = np.stack([glyphs.target(name).mask for name in glyphs.objects()])
    rows = drawn.reshape(LETTERS.writers, -1, LETTER_PX, LETTER_PX).swapaxes(1, 2)
    sheet = np.round(255 * rows.reshape(LETTERS.writers * LETTER_PX, -1)).astype(np.uint8)
    Image.fromarray(sheet).save(LETTERS_FILE, optimize=True)


if __name__ == "__main__":
    main()
