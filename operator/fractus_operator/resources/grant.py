"""Builders of Grants, and of their status from the reports of a node's agent."""

from __future__ import annotations

from fractus_core.api import Application
from fractus_core.api.grants import ENDED, GrantSpec, ReportedGrant

from fractus_operator import kinds, labels
from fractus_operator.kinds import Body
from fractus_operator.labels import application_labels, grant_name

_LABELS = (
    labels.APPLICATION_LABEL,
    labels.MANAGED_LABEL,
    labels.NAMESPACE_LABEL,
    labels.COMPONENT_LABEL,
    labels.INSTANCE_LABEL,
)


def grant(application: Application, spec: GrantSpec) -> Body:
    """Return the Grant of an instance.

    A Grant is cluster-scoped, so labels name its Application, not an owner reference.
    """
    namespace, _ = application.key
    body = kinds.GRANT.header(grant_name(namespace, spec.instance))
    body["metadata"]["labels"] = {
        **application_labels(application),
        labels.NAMESPACE_LABEL: namespace,
        labels.COMPONENT_LABEL: spec.component,
        labels.INSTANCE_LABEL: spec.instance,
    }
    body["spec"] = _unsigned(spec)
    return body


def regranted(observed: Body, spec: GrantSpec) -> Body:
    """Return the manifest of an existing Grant with a new spec.

    The metadata has the same fields as a manifest from `grant`.
    """
    body = kinds.GRANT.header(observed["metadata"]["name"])
    present = observed["metadata"].get("labels") or {}
    body["metadata"]["labels"] = {label: present[label] for label in _LABELS if label in present}
    body["spec"] = _unsigned(spec)
    return body


def _unsigned(spec: GrantSpec) -> Body:
    """Return the spec without the fields that signing adds, for the comparison with a signed Grant.

    Defaults are omitted. A field that a later release adds then changes no Grant that does not use it, and services of the
    previous release can still parse such Grants.
    """
    return spec.unsigned.model_dump(mode="json", by_alias=True, exclude_defaults=True)


def reported_status(observed: Body, report: ReportedGrant) -> Body | None:
    """Return the new status of a Grant after a report, or None if the status does not change.

    A reported final phase is never replaced.

    Args:
        observed: The Grant at the API server.
        report: The latest report of the agent of its node.
    """
    known = observed.get("status") or {}
    status: Body = {"phase": report.phase, "message": report.message}
    if report.waypoints is not None:
        status["waypoints"] = report.waypoints.model_dump(mode="json", by_alias=True)
    if report.pictures is not None:
        status["pictures"] = report.pictures.model_dump(mode="json", by_alias=True)
    if known.get("phase") in ENDED:
        status = {"phase": known["phase"], "message": known.get("message") or ""}
    status["observedGeneration"] = report.observed_generation
    return None if all(known.get(field) == value for field, value in status.items()) else status
