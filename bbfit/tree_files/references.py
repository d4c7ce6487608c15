"""What the readers of references share: which of the named files exist, and whether the tree may refer to them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from bbfit.inputs import InputLimits

_UDIM = "<UDIM>"


def existing(source: Path, names: Iterable[str], folder: Path, limits: InputLimits) -> list[Path]:
    """The existing files among the paths that ``source`` contains, relative to its own folder. A ``<UDIM>`` stands for four digits.

    Raises ``InputError`` if one of them lies outside ``folder`` and ``limits`` do not allow it, or if one is a device or a pipe.
    """
    files = list[Path]()
    for name in names:
        if "\0" in name or not name:
            continue
        spelled = [name]
        if _UDIM in name:
            stem = Path(name.replace(_UDIM, "0" * 4)).name
            pattern = stem.replace("0" * 4, "[0-9]" * 4)
            spelled = [str(Path(name).parent / tile.name) for tile in sorted((source.parent / name).parent.glob(pattern))]
        for each in spelled:
            try:
                if not (source.parent / each).exists() or (source.parent / each).is_dir():
                    continue
            except (OSError, ValueError):  # too long, or not the name of any file
                continue
            files.append(limits.referenced("tree", source, each, folder))
    return list(dict.fromkeys(files))
