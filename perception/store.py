"""Stores a fitted recogniser in a file that cannot run code when it is read.

The file is a skops archive, which describes types and arrays. Reading it creates only objects of
scikit-learn's types and of the types in `OURS`. Pickles are rejected.
"""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from typing import Any

import numpy as np
import skops.io
from sklearn.base import BaseEstimator
from sklearn.pipeline import Pipeline

from perception.appearance import PanoramaTransformer, ReciprocalTransformer
from perception.errors import PerceptionError
from perception.images import refuse_huge
from perception.recognition import PlaceRecogniser
from perception.views import Predictor, ViewClusterer
from ssh_abduction.data.errors import brief, is_whole
from ssh_abduction.data.files import save_file

FORMAT, VERSION = "ssh-recogniser", 1
OURS = tuple(
    f"{kind.__module__}.{kind.__qualname__}"
    for kind in (
        PlaceRecogniser,
        PanoramaTransformer,
        ReciprocalTransformer,
        ViewClusterer,
        Predictor,
    )
)


def save(model: Any, path: str | os.PathLike[str]) -> None:
    """Write a fitted estimator or pipeline to a file, completely or not at all.

    Its types are of this package or of scikit-learn. Raises PerceptionError if `load` would
    reject it, or the file cannot be written.
    """
    save_file(path, written(model, str(path)), "recogniser", PerceptionError)


def written(model: Any, name: str = "recogniser") -> bytes:
    """Make the content of a file that stores a fitted estimator or pipeline.

    Raises PerceptionError, with this name of the file, if `load` would reject it.
    """
    classes = np.asarray(getattr(model, "classes_", ())).tolist()
    versions = {
        name: version(name) for name in ("numpy", "scikit-learn", "skops", "ssh-abduction")
    } | {"python": platform.python_version()}
    parts = {"format": FORMAT, "version": VERSION, "model": model, "classes": classes}
    data: bytes = skops.io.dumps({**parts, "versions": versions})
    # Reject now what `load` would reject later.
    if foreign := _foreign(data=data):
        raise PerceptionError(
            f"{name}: expected a model of types that can be read back, got {', '.join(foreign)}; "
            "use an estimator of scikit-learn"
        )
    return data


def load(path: str | os.PathLike[str]) -> Any:
    """Read an estimator or pipeline that `save` wrote, without running anything in the file.

    Raises PerceptionError if the file is unreadable or has other content.
    """
    try:
        # Measure and check the types before reading any object.
        refuse_huge(path, path, "train with fewer images")
        if foreign := _foreign(file=path):
            raise PerceptionError(
                f"{path}: expected scikit-learn's and this package's types only, got "
                f"{', '.join(foreign)}; do not trust it"
            )
        held = skops.io.load(path, trusted=list(OURS))
    except PerceptionError:
        raise
    except OSError as error:
        raise PerceptionError(
            f"{path}: expected a readable recogniser: {error.strerror or error}; check the path"
        ) from None
    except Exception as error:  # Each part of a damaged archive fails in its own way.
        raise PerceptionError(
            f"{path}: expected a .skops file that train or save wrote, got something else "
            f"({type(error).__name__}); train it again"
        ) from error
    _check_parts(held, path)
    try:
        return _learnt_again(held["model"])
    except Exception as error:  # Each part of a damaged model fails in its own way.
        raise PerceptionError(
            f"{path}: model: expected a fitted one, got {type(error).__name__}: {error}; "
            "train it again"
        ) from None


def _check_parts(held: object, path: str | os.PathLike[str]) -> None:
    """Raise PerceptionError if an object is not the dict that `save` wrote to a file."""
    if (
        not isinstance(held, dict)
        or not isinstance(held.get("format"), str)
        or held["format"] != FORMAT
    ):
        raise PerceptionError(
            f"{path}: expected a file of format {FORMAT}, got another object; write it with "
            "train or save"
        )
    version = held.get("version")
    if not is_whole(version) or version != VERSION:
        raise PerceptionError(
            f"{path}: expected version {VERSION}, got {_kind(version)}; use the program that "
            "wrote it"
        )
    for part, kind in (("model", BaseEstimator), ("classes", list), ("versions", dict)):
        if not isinstance(held.get(part), kind):
            raise PerceptionError(
                f"{path}: {part}: expected a {kind.__name__}, got {_kind(held.get(part))}; "
                "save the recogniser again"
            )


def _learnt_again(model: Any) -> Any:
    """Copy a model, with place recognisers that learnt their images again.

    Learning again checks the tables of images. scikit-learn's compiled search trusts its tables, so
    a table that was damaged in a file could crash the process. Damage raises PerceptionError,
    ValueError, or other errors of numpy.
    """
    if isinstance(model, PlaceRecogniser):
        return PlaceRecogniser(model.n_neighbors).fit(*model.remembered())
    if isinstance(model, Pipeline):
        return Pipeline([(name, _learnt_again(step)) for name, step in model.steps])
    return model


def _kind(value: object) -> str:
    """Describe a value in an error message: objects by their type, as their own text may raise."""
    return (
        brief(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
    )


def _foreign(**source: Any) -> list[str]:
    """The names of types in a dump that are neither scikit-learn's nor in `OURS`, sorted."""
    return sorted(set(skops.io.get_untrusted_types(**source)) - set(OURS))
