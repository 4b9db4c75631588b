"""`evnlos doctor`: is the installation whole?"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class DoctorCommand:
    """Check the installation (torch, numba, HDF5, fonts, disk, optional parts), with a cure for each fault."""

    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Print each part; exit code 1 where a needed one is broken."""
        from evnlos.doctor import examine

        parts = examine()
        if self.json:
            print(json.dumps({"parts": [asdict(part) for part in parts]}))
        else:
            for part in parts:
                mark = "  ok     " if part.there else "! BROKEN " if part.needed else "- without"
                print(f"{mark} {part.name}: {part.found}" + (f"; {part.cure}" if part.cure else ""))
        if any(part.needed and not part.there for part in parts):
            raise SystemExit(1)
