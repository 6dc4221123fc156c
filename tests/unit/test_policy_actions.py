"""Selection of repair actions: permitted choices, granted actions, and changes of policies in flight."""

import dataclasses

import pytest
from fractus_core.api import Application, InvalidObject
from fractus_core.planning import plan
from fractus_core.planning.grant_compiler import compile_grants, refresh
from fractus_core.policy.compiled_grant import compile_grant
from fractus_core.policy.decision_types import Airframe, Call, GotoArgs, Home, Situation
from fractus_core.policy.engine import judge
from test_grants import policy, zone
from test_plan_legality import APP, NOW, WARN, stock
from test_planning import at

FENCE = {"type": "GeofenceControl", "kind": "exclusion"}
FAR = zone("far", (150, 80), 20)
PLACE = {name: at(100, 0)[name] for name in ("lat", "lon")}
OTHER = {name: at(120, 0)[name] for name in ("lat", "lon")}


def choosing(*actions):
    body = APP.to_dict()
    return Application.from_body(body | {"spec": body["spec"] | {"policyActions": list(actions)}})


def fence(name="far", **more):
    return policy(name, zones=["far"], **FENCE | more)


def granted(app, *policies):
    inventory = stock(*policies, zones=[FAR])
    (grant,) = compile_grants(app, plan(app, inventory, WARN), inventory)
    return grant


def effects(grant):
    return [(p.name, p.spec.action, p.selected, p.spec.choices) for p in grant.policies]


def test_action_of_policy_applies_without_selection():
    grant = granted(APP, fence(action="hover", choices=["abort", "land"], landAt=PLACE))
    assert effects(grant) == [("far", "hover", False, ())]
    assert grant.policies[0].spec.land_at is None


def test_grant_contains_selected_action_only():
    app = choosing({"policy": "far", "action": "land"})
    assert effects(granted(app, fence(action="hover", choices=["land", "abort"]))) == [("far", "land", True, ())]
    own = choosing({"policy": "far", "action": "hover"})
    assert effects(granted(own, fence(action="hover", choices=["land"]))) == [("far", "hover", True, ())]


@pytest.mark.parametrize(
    ("selection", "place"), [({}, PLACE), ({"landAt": OTHER}, OTHER)], ids=["place of policy", "own place"]
)
def test_selected_abort_has_landing_place(selection, place):
    app = choosing({"policy": "far", "action": "abort"} | selection)
    grant = granted(app, fence(choices=["abort"], landAt=PLACE))
    assert grant.policies[0].spec.land_at.to_dict() == pytest.approx(place)


def test_selected_filter_has_no_settings_of_another_filter():
    hidden = policy("p", type="PrivacyControl", kind="camera", action="blurFaces", faces="gaussian", choices=["black"])
    grant = granted(choosing({"policy": "p", "action": "black"}), hidden)
    assert (grant.policies[0].spec.action, grant.policies[0].spec.faces) == ("black", None)


@pytest.mark.parametrize(
    ("selection", "problem"),
    [
        ({"policy": "none", "action": "hover"}, r"spec\.policyActions\[0\]\.policy: there is no Policy none"),
        (
            {"policy": "far", "action": "ignore"},
            r"spec\.policyActions\[0\]\.action: policy far does not permit ignore; select one of: revoke, hover",
        ),
        (
            {"policy": "fixed", "action": "abort", "landAt": OTHER},
            r"spec\.policyActions\[0\]\.landAt: policy fixed does not offer abort in spec\.choices",
        ),
        ({"policy": "alone", "action": "hover"}, "policy alone does not permit hover; select one of: revoke"),
        ({"policy": "limit", "action": "enforce"}, "policy limit does not permit enforce; select one of: no choice"),
    ],
)
def test_missing_or_foreign_selection_is_refused(selection, problem):
    policies = (
        fence(action="revoke", choices=["hover"]),
        fence("alone", action="revoke"),
        fence("fixed", action="abort", choices=["hover"], landAt=PLACE),
        policy("limit", type="LimitControl", kind="speed", upperLimit=5),
    )
    with pytest.raises(InvalidObject, match=problem):
        plan(choosing(selection), stock(*policies, zones=[FAR]), WARN)


def test_second_selection_for_a_policy_is_refused():
    with pytest.raises(InvalidObject, match="policyActions has at most one entry for each policy"):
        choosing({"policy": "p", "action": "hover"}, {"policy": "p", "action": "land"})


def test_selection_is_kept_by_refresh_while_policy_permits_it():
    app = choosing({"policy": "far", "action": "abort", "landAt": OTHER})
    grant = granted(app, fence(action="hover", choices=["abort"]))

    def refreshed(**spec):
        return refresh(grant, stock(fence(**spec), zones=[FAR]))

    assert refreshed(action="hover", choices=["abort"]) == grant
    same = refreshed(action="land", choices=["abort", "revoke"])
    assert effects(same) == [("far", "abort", True, ())]
    assert same.policies[0].spec.land_at == grant.policies[0].spec.land_at
    assert effects(refreshed(action="land", choices=["revoke"])) == [("far", "land", False, ())]
    assert refreshed(action="land").policies[0].spec.land_at is None


@pytest.mark.parametrize("moved", [{"landAt": OTHER}, {}], ids=["moved", "withdrawn"])
@pytest.mark.parametrize(
    "spec", [{"action": "abort"}, {"action": "hover", "choices": ["abort"]}], ids=["action", "choice"]
)
def test_landing_place_of_policy_follows_the_policy_when_refreshed(spec, moved):
    grant = granted(choosing({"policy": "far", "action": "abort"}), fence(landAt=PLACE, **spec))
    now = fence(**spec, **moved)
    (kept,) = refresh(grant, stock(now, zones=[FAR])).policies
    assert (kept.spec.action, kept.selected, kept.spec.land_at) == ("abort", True, now.spec.land_at)


def test_landing_place_of_application_ends_when_abort_is_not_a_choice_any_more():
    app = choosing({"policy": "far", "action": "abort", "landAt": OTHER})
    grant = granted(app, fence(action="hover", choices=["abort"]))
    fixed = stock(fence(action="abort", landAt=PLACE), zones=[FAR])
    (kept,) = refresh(grant, fixed).policies
    (compiled,) = compile_grants(app, plan(APP, fixed, WARN), fixed, present=[grant])
    assert kept.spec.land_at.to_dict() == pytest.approx(PLACE)
    assert compiled.policies == (kept,)


def test_policy_without_selection_follows_its_own_action_when_refreshed():
    grant = granted(APP, fence(action="hover", choices=["land"]))
    changed = stock(fence(action="revoke", choices=["hover"]), zones=[FAR])
    assert effects(refresh(grant, changed)) == [("far", "revoke", False, ())]


def test_running_mission_is_planned_again_although_its_selection_is_not_permitted_any_more():
    app = choosing({"policy": "far", "action": "land"})
    inventory = stock(fence(action="hover", choices=["land"]), zones=[FAR])
    present = plan(app, inventory, WARN)
    (grant,) = compile_grants(app, present, inventory)
    withdrawn = dataclasses.replace(inventory, policies={"far": fence(action="hover")})
    again = plan(app, withdrawn, WARN, present)
    (kept,) = compile_grants(app, again, withdrawn, present=[grant])
    assert effects(kept) == [("far", "hover", False, ())]


def test_most_restrictive_policy_wins_over_a_selection():
    app = choosing({"policy": "far", "action": "ignore"})
    policies = (fence(action="revoke", choices=["ignore"]), fence("strict", action="land"))
    compiled = compile_grant(granted(app, *policies))
    spot = at(100, 0, 10)
    home = Home(at(0, 0)["lat"], at(0, 0)["lon"], 0.0)
    now = Situation(
        NOW, spot["lat"], spot["lon"], 10.0, home=home, armed=True, in_air=True, airframe=Airframe(retraces=True)
    )
    into = GotoArgs(at(150, 80)["lat"], at(150, 80)["lon"], 10.0)
    verdict = judge(Call("Goto", into), now, dataclasses.replace(compiled, operation_area=None, flight_area=None))
    assert (verdict.takeover, verdict.policies) == ("land", ("strict", "far"))
