"""Whether an object is as it should be, so that an unchanged one is not written again."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from fractus_operator.cluster.kinds import Body
from fractus_operator.cluster.labels import CERTIFICATE_ANNOTATION, DIGEST_ANNOTATION


def digest(desired: Body) -> str:
    """A digest of what is to be applied; a certificate that is renewed changes nothing else."""
    annotations = desired["metadata"].get("annotations") or {}
    if CERTIFICATE_ANNOTATION in annotations:
        rest = {name: value for name, value in annotations.items() if name != CERTIFICATE_ANNOTATION}
        desired = {**desired, "metadata": {**desired["metadata"], "annotations": rest}}
    return hashlib.sha256(json.dumps(desired, sort_keys=True, separators=(",", ":")).encode()).hexdigest()[:16]


def stamped(desired: Body) -> Body:
    """The object with the digest of its content as an annotation."""
    metadata = dict(desired["metadata"])
    metadata["annotations"] = {**metadata.get("annotations", {}), DIGEST_ANNOTATION: digest(desired)}
    return {**desired, "metadata": metadata}


def is_current(desired: Body, observed: Body | None) -> bool:
    """Whether applying the stamped object would change nothing.

    Two things must hold: the digest is that of the last apply (so no field was dropped since), and
    every field still has the applied value (so no one else changed one).
    """
    if observed is None:
        return False
    stamp = (observed["metadata"].get("annotations") or {}).get(DIGEST_ANNOTATION)
    return stamp == desired["metadata"].get("annotations", {}).get(DIGEST_ANNOTATION) and contains(observed, desired)


def contains(observed: Any, desired: Any) -> bool:
    """Whether every field of the desired value has that value in the observed one; others may be there too."""
    if observed == desired:
        # Areas have many points: this compares them at once.
        return True
    if isinstance(desired, dict):
        if not desired:
            return observed is None or isinstance(observed, dict)
        return isinstance(observed, dict) and all(contains(observed.get(key), value) for key, value in desired.items())
    if isinstance(desired, list):
        if not desired:
            return not observed
        return (
            isinstance(observed, list)
            and len(observed) == len(desired)
            and all(contains(o, d) for o, d in zip(observed, desired, strict=True))
        )
    return observed is None and desired in ("", None, False)
