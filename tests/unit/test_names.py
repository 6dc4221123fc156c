"""Names of what is made for a component: labels that tell every namespace, application, component and node apart."""

import itertools
import re

import pytest
from depth import examples
from fractus_core.api import Component
from fractus_core.planning import instance_name
from fractus_operator.labels import grant_name, label_value, secret_name, service_name
from hypothesis import given, settings
from hypothesis import strategies as st

LABEL = re.compile(r"[a-z]([-a-z0-9]{0,61}[a-z0-9])?")


def named(name):
    return Component.model_construct(name=name)


def instance(application, component, node=None):
    return instance_name(application, named(component), node)


def divisions(tokens):
    """Every way to read a row of words as an application, a component and perhaps a node, with hyphens or with dots."""
    found = []
    for i, j in itertools.combinations(range(1, len(tokens) + 1), 2):
        component, node = "-".join(tokens[i:j]), tokens[j:]
        if not component[0].isalpha():
            continue
        found += [(mark.join(tokens[:i]), component, inner.join(node) or None) for mark in "-." for inner in "-."]
    return list(dict.fromkeys(found))


words = st.lists(st.sampled_from(["a", "b", "e", "1", "edge", "stat", "c2", "x" * 20]), min_size=2, max_size=6)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (("a", "Viewer", "e.1"), ("a", "Viewer", "e-1")),
        (("a", "Stat", "e-1"), ("a", "Stat-e", "1")),
        (("a", "B-c"), ("a-b", "C")),
        (("a", "B", "c"), ("a", "B-c")),
        (("a.b", "C"), ("a-b", "C")),
    ],
)
def test_instances_that_are_joined_alike_are_told_apart(one, other):
    assert instance(*one) != instance(*other)
    if len(one) == 2:
        assert service_name(one[0], named(one[1])) != service_name(other[0], named(other[1]))


@given(words)
@settings(max_examples=examples(400, 40), deadline=None)
def test_every_division_of_the_same_words_has_its_own_name(tokens):
    divided = divisions(tokens)
    names = [instance(*parts) for parts in divided]
    # What looks like a name that was made already, hash and all, takes no other's.
    made = {parts for name in names for parts in divisions(name.split("-"))} if len(tokens) < 4 else set()
    everything = list(dict.fromkeys([*divided, *made]))
    names = [instance(*parts) for parts in everything]
    assert len(set(names)) == len(everything)
    assert all(LABEL.fullmatch(name) and LABEL.fullmatch(secret_name(name)) for name in names)
    served = list(dict.fromkeys((application, component) for application, component, _ in everything))
    services = [service_name(application, named(component)) for application, component in served]
    assert len(set(services)) == len(served)
    assert all(LABEL.fullmatch(name) for name in services)


kubernetes = st.text("ab1-.", min_size=1, max_size=72).map(lambda text: f"{text.strip('-.')}x")
components = st.text("aAB1-", max_size=38).map(lambda text: f"a{text}".strip("-"))


def told_apart_by(parts):
    namespace, application, component, node = parts
    return namespace, application, named(component).slug, node


@given(
    st.lists(
        st.tuples(st.sampled_from(["a", "a-b", "b"]), kubernetes, components, st.none() | kubernetes),
        min_size=2,
        unique_by=told_apart_by,
    )
)
@settings(max_examples=examples(400, 40), deadline=None)
def test_no_two_instances_share_a_grant(instances):
    names = [grant_name(namespace, instance(*parts)) for namespace, *parts in instances]
    assert len(set(names)) == len(names)
    assert all(LABEL.fullmatch(instance(*parts)) for _, *parts in instances)


@pytest.mark.parametrize(
    ("parts", "name"),
    [
        (("traffic", "DataStore"), "traffic-data-store"),
        (("traffic", "ImageChecker", "edge-1"), "traffic-image-checker-edge-1"),
        (("traffic", "Checker", "e12"), "traffic-checker-e12"),
    ],
)
def test_names_that_can_be_read_back_have_no_hash(parts, name):
    assert instance(*parts) == name


def test_other_names_begin_with_what_they_are_joined_of():
    assert re.fullmatch(r"traffic-monitoring-data-store-[0-9a-f]{10}", instance("traffic-monitoring", "DataStore"))
    assert re.fullmatch(r"a-1st-viewer-[0-9a-f]{10}", service_name("1st", named("Viewer")))
    assert instance("traffic-monitoring", "DataStore") == instance("traffic-monitoring", "DataStore")


def test_a_name_that_looks_shortened_is_no_label_of_another():
    long = "v" * 200
    assert label_value(label_value(long)) != label_value(long)
    assert len(label_value(label_value(long))) <= 63
    assert label_value("v" * 63) == "v" * 63
