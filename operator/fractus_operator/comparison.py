"""Compares desired with observed objects, so that an unchanged object is not written again."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from fractus_operator.kinds import Body
from fractus_operator.labels import CERTIFICATE_ANNOTATION, DIGEST_ANNOTATION


def stamped(desired: Body) -> Body:
    """Return the object with the digest of its content as an annotation. A renewed certificate does not change the digest."""
    metadata = desired["metadata"]
    annotations = metadata.get("annotations") or {}
    content = desired
    if CERTIFICATE_ANNOTATION in annotations:
        rest = {name: value for name, value in annotations.items() if name != CERTIFICATE_ANNOTATION}
        content = {**desired, "metadata": {**metadata, "annotations": rest}}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return {**desired, "metadata": {**metadata, "annotations": {**annotations, DIGEST_ANNOTATION: digest}}}


def is_current(desired: Body, observed: Body | None) -> bool:
    """Return True if applying the stamped object would change nothing.

    Two conditions must hold. The digest equals the digest of the last apply, so no field was removed from the desired object
    since. Every desired field has its value in the observed object, so no other client changed a field.
    """
    if observed is None:
        return False
    stamp = (observed["metadata"].get("annotations") or {}).get(DIGEST_ANNOTATION)
    return stamp == desired["metadata"].get("annotations", {}).get(DIGEST_ANNOTATION) and contains(observed, desired)


def contains(observed: Any, desired: Any) -> bool:
    """Return True if every field of the desired value has that value in the observed value.

    The observed value may have more fields. Missing and empty values are equal.
    """
    if observed == desired:
        # Fast path for areas with many points.
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
