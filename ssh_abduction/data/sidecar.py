"""The sidecar file of a trace, which holds its images as one table."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from ssh_abduction.data.trace import Trace


def images_file(trace: Trace) -> Path | None:
    """Return the path of the sidecar file; None if the trace names none.

    A trace names it relative to its own file, or to the working folder if it has no file.
    """
    return Path(trace.source or ".").parent / trace.images if trace.images else None


def with_images_named_from(trace: Trace, folder: str | os.PathLike[str]) -> Trace:
    """Copy a trace that will be saved in another folder, so that it still names its images."""
    path = images_file(trace)
    return trace if path is None else replace(trace, images=os.path.relpath(path, folder))
