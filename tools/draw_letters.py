"""Draw the letters of the usual prior, which come with the package; a row a writer.

python tools/draw_letters.py        # src/evnlos/inverse/letters.png
"""

import numpy as np
from PIL import Image

from evnlos.inverse.prior import LETTER_PX, LETTERS, LETTERS_FILE
from evnlos.types import Plane


def main() -> None:
    """Write the sheet."""
    squares = Plane(LETTER_PX, LETTER_PX, LETTERS.target_plane.size_m / LETTER_PX)
    drawn = np.stack([LETTERS.target(name).rasterise(squares) for name in LETTERS.objects()])
    rows = drawn.reshape(LETTERS.writers, -1, LETTER_PX, LETTER_PX).swapaxes(1, 2)
    sheet = np.round(255 * rows.reshape(LETTERS.writers * LETTER_PX, -1)).astype(np.uint8)
    Image.fromarray(sheet).save(LETTERS_FILE, optimize=True)


if __name__ == "__main__":
    main()
