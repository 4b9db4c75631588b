"""Write the checksums of the published captures, which `evnlos lab --set` compares with.

    python tools/published_captures.py near=captures far=captures

Each word names a set and the folder into which `evnlos lab --set NAME --out FOLDER` rendered it.
"""

import sys
from pathlib import Path

from evnlos.data import read_capture
from evnlos.report.provenance import PUBLISHED, content_digest


def main() -> None:
    """Write the SHA-256 of what each capture holds, and its number of events."""
    lines = []
    for name, _, folder in (word.partition("=") for word in sys.argv[1:]):
        lines.append(f"{name}:")
        for path in sorted(Path(folder).glob(f"{name}_?")):
            capture = read_capture(path)
            character = path.name.removeprefix(f"{name}_")
            lines.append(f'  "{character}": [{content_digest(capture)}, {len(capture.events)}]')
    PUBLISHED.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
