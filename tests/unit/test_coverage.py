"""Lazy greedy coverage compared with the plain greedy algorithm, and sampled areas compared with exact areas."""

import numpy as np
import pytest
import shapely
from depth import examples
from fractus_core.planning.coverage import CoverScene, Samples, greedy_cover
from hypothesis import given, settings
from hypothesis import strategies as st

spots = st.tuples(st.floats(-400, 400), st.floats(-400, 400))
paths = st.lists(spots, min_size=2, max_size=6, unique_by=lambda p: (round(p[0]), round(p[1])))


def corridor(path, width=7):
    return shapely.LineString(path).buffer(width, quad_segs=16)


@given(paths, spots, st.floats(20, 400))
@settings(max_examples=examples(60), deadline=None)
def test_coverage_samples_lie_inside_the_shape_and_represent_its_area(path, centre, radius):
    shape = corridor(path)
    samples = Samples(shape)
    xy = samples.xy()
    assert len(xy) == len(samples) >= 1000
    assert shapely.dwithin(shape, shapely.points(xy), 1e-6).all()
    assert len(samples) * samples.spacing_m**2 == pytest.approx(shape.area, rel=0.02)
    _, first, end = samples.runs(np.array([centre]), np.array([radius]))
    counted = int((end - first).sum())
    assert counted == int((np.hypot(*(xy - centre).T) <= radius).sum())
    exact = shapely.Point(centre).buffer(radius, quad_segs=64).intersection(shape).area / shape.area
    assert counted / len(samples) == pytest.approx(exact, abs=0.015)


def test_coverage_samples_exclude_holes_and_include_every_part():
    ring = shapely.Point(0, 0).buffer(100).difference(shapely.Point(0, 0).buffer(60))
    shape = ring.union(shapely.box(300, 300, 320, 320))
    xy = Samples(shape).xy()
    assert not (np.hypot(*xy.T) < 59).any()
    assert (xy > 300).all(axis=1).any()


def test_coverage_samples_of_long_narrow_path_represent_its_area():
    shape = shapely.LineString([(0, 0), (40_000, 40_000)]).buffer(7)
    samples = Samples(shape)
    assert samples.spacing_m <= 3.6
    assert len(samples) * samples.spacing_m**2 == pytest.approx(shape.area, rel=0.01)


def plain_greedy(points, discs, share, unfit):
    """Return the choices of the plain greedy algorithm.

    It evaluates every candidate in every round, and chooses the first of equal candidates.
    """
    reached = {
        name: {i for i, p in enumerate(points) if (p[0] - x) ** 2 + (p[1] - y) ** 2 <= r * r}
        for name, (x, y, r) in discs.items()
    }
    covered = set()
    picks = []
    remaining = list(discs)
    while remaining and len(covered) < share * len(points):
        gains = [len(reached[name] - covered) for name in remaining]
        best = max(gains)
        if best == 0:
            break
        name = remaining.pop(gains.index(best))
        if name in unfit:
            continue
        covered |= reached[name]
        picks.append((name, best))
    return picks


discs = st.lists(
    st.tuples(st.floats(-450, 450), st.floats(-450, 450), st.sampled_from([30, 80, 80, 80, 150])), max_size=14
)


@given(paths, discs, st.sets(st.integers(0, 13), max_size=4), st.sampled_from([0.3, 0.95, 1.0]))
@settings(max_examples=examples(80), deadline=None)
def test_lazy_greedy_coverage_equals_plain_greedy(path, candidates, unfit, share):
    samples = Samples(corridor(path, width=25))
    named = {f"n{i:02d}": disc for i, disc in enumerate(candidates)}
    refused = {f"n{i:02d}" for i in unfit}
    xy = np.array([d[:2] for d in candidates], dtype=float).reshape(-1, 2)
    scene = CoverScene(samples, list(named), xy, np.array([d[2] for d in candidates], dtype=float), share)
    picks = greedy_cover(scene, lambda name: name not in refused)
    expected = plain_greedy(samples.xy().tolist(), named, share, refused)
    assert [(p.name, round(p.share * len(samples))) for p in picks] == expected


def test_lazy_greedy_coverage_equals_plain_greedy_for_more_than_one_batch():
    rng = np.random.default_rng(5)
    samples = Samples(corridor([(0, 0), (300, 80), (600, -40)]))
    xy = np.column_stack((rng.uniform(-50, 650, 700), rng.uniform(-80, 120, 700)))
    names = [f"n{i:03d}" for i in range(len(xy))]
    scene = CoverScene(samples, names, xy, np.full(len(xy), 60.0), 0.95)
    chosen = [(p.name, round(p.share * len(samples))) for p in greedy_cover(scene, lambda _: True)]
    reached = np.hypot(*(samples.xy()[None] - xy[:, None]).transpose(2, 0, 1)) <= 60.0
    covered = np.zeros(len(samples), dtype=bool)
    expected = []
    while covered.sum() < 0.95 * len(samples):
        gains = (reached & ~covered).sum(axis=1)
        best = int(np.argmax(gains))
        expected.append((names[best], int(gains[best])))
        covered |= reached[best]
    assert chosen == expected


def test_greedy_coverage_keeps_nodes_and_counts_covered_samples():
    samples = Samples(corridor([(0, 0), (400, 0)]))
    xy = np.array([[100.0, 0], [120.0, 0], [300.0, 0]])
    reach = np.full(3, 110.0)
    scene = CoverScene(samples, ["a", "b", "c"], xy, reach, 0.95, kept=frozenset({"b"}))
    assert greedy_cover(scene, lambda _: True)[0].name == "b"
    covered = CoverScene(samples, ["a", "b", "c"], xy, reach, 0.95, covered_by=np.array([[100.0, 0, 200]]))
    assert [p.name for p in greedy_cover(covered, lambda _: True)] == ["c"]
