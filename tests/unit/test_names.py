"""Names of child objects: labels that are unique for each namespace, application, component and node."""

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
    """Return all divisions of the tokens into application, component and optional node.

    The tokens of a name are joined by hyphens or dots.
    """
    results = []
    for i, j in itertools.combinations(range(1, len(tokens) + 1), 2):
        component = "-".join(tokens[i:j])
        node = tokens[j:]
        if not component[0].isalpha():
            continue
        results += [(mark.join(tokens[:i]), component, inner.join(node) or None) for mark in "-." for inner in "-."]
    return list(dict.fromkeys(results))


words = st.lists(st.sampled_from(["a", "b", "e", "1", "edge", "stat", "c2", "x" * 20]), min_size=2, max_size=6)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (("a", "Viewer", "e.1"), ("a", "Viewer", "e-1")),
        (("a", "Stat", "e-1"), ("a", "Stat-e", "1")),
        (("a", "B-c"), ("a-b", "C")),
        (("a", "B", "c"), ("a", "B-c")),
        (("a.b", "C"), ("a-b", "C")),
    ],
)
def test_instance_names_differ_when_joined_parts_are_equal(first, second):
    assert instance(*first) != instance(*second)
    if len(first) == 2:
        assert service_name(first[0], named(first[1])) != service_name(second[0], named(second[1]))


@given(words)
@settings(max_examples=examples(400, 40), deadline=None)
def test_instance_names_differ_for_every_division_of_same_words(tokens):
    divided = divisions(tokens)
    names = [instance(*parts) for parts in divided]
    # Objects may have names that imitate generated names, including the hash. The results must still be unique.
    generated = {parts for name in names for parts in divisions(name.split("-"))} if len(tokens) < 4 else set()
    everything = list(dict.fromkeys([*divided, *generated]))
    names = [instance(*parts) for parts in everything]
    assert len(set(names)) == len(everything)
    assert all(LABEL.fullmatch(name) and LABEL.fullmatch(secret_name(name)) for name in names)
    served = list(dict.fromkeys((application, component) for application, component, _ in everything))
    services = [service_name(application, named(component)) for application, component in served]
    assert len(set(services)) == len(served)
    assert all(LABEL.fullmatch(name) for name in services)


kubernetes = st.text("ab1-.", min_size=1, max_size=72).map(lambda text: f"{text.strip('-.')}x")
components = st.text("aAB1-", max_size=38).map(lambda text: f"a{text}".strip("-"))


def identity_of(parts):
    namespace, application, component, node = parts
    return namespace, application, named(component).slug, node


@given(
    st.lists(
        st.tuples(st.sampled_from(["a", "a-b", "b"]), kubernetes, components, st.none() | kubernetes),
        min_size=2,
        unique_by=identity_of,
    )
)
@settings(max_examples=examples(400, 40), deadline=None)
def test_grant_names_differ_for_different_instances(instances):
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
def test_unambiguous_instance_names_have_no_hash(parts, name):
    assert instance(*parts) == name


def test_ambiguous_instance_names_have_readable_prefix():
    assert re.fullmatch(r"traffic-monitoring-data-store-[0-9a-f]{10}", instance("traffic-monitoring", "DataStore"))
    assert re.fullmatch(r"a-1st-viewer-[0-9a-f]{10}", service_name("1st", named("Viewer")))
    assert instance("traffic-monitoring", "DataStore") == instance("traffic-monitoring", "DataStore")


def test_label_value_of_shortened_name_differs():
    long = "v" * 200
    assert label_value(label_value(long)) != label_value(long)
    assert len(label_value(label_value(long))) <= 63
    assert label_value("v" * 63) == "v" * 63
