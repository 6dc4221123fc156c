"""`fractus check`: problems of driver programs, by line."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest
from fractus_cli.main import run
from fractus_cli.program_check import check_program

ROOT = Path(__file__).parents[2]
PROGRAM = """\
import asyncio, subprocess, time
from time import sleep
import fractus

async def patrol(drone, control):
    await drone.arm()
    {statement}

fractus.run(patrol)
"""


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("drone.takeoff(20)", "takeoff is not awaited, so it has no effect: write `await drone.takeoff(20)`"),
        ("drone.hover()", "hover is not awaited"),
        ("drone.mission()", "mission is not awaited"),
        ("control.report(1)", "report is not awaited"),
        ("if drone.can_i.goto(1, 2, 3): pass", "goto is not awaited"),
        ("print(drone.position().position)", "position is not awaited"),
        ("for point in control.remaining(): pass", "use `async for ... in control.remaining()`"),
        ("await drone.fly_to(1, 2, 3)", "Mobility has no method fly_to"),
        ("await drone.take_off(3)", "did you mean takeoff?"),
        ("await drone.goto(1, 2)", "Mobility.goto: missing a required argument: 'alt'"),
        ("await drone.goto(1, 2, 3, height=4)", "Mobility.goto: got an unexpected keyword argument 'height'"),
        ("await drone.can_i.fly(1)", "CanI has no method fly"),
        ("time.sleep(40)", "`time.sleep` blocks the event loop"),
        ("sleep(40)", "use `await asyncio.sleep(...)`"),
        ("subprocess.run(['ls'])", "use `await asyncio.to_thread(...)`"),
        ("while True: pass", "the loop never awaits"),
        ("try: await drone.hover()\n    except: pass", "suppresses the cancellation"),
        ("try: await drone.hover()\n    except asyncio.CancelledError: pass", "suppresses the cancellation"),
    ],
)
def test_problem_in_a_program_is_reported_with_its_line(statement: str, problem: str) -> None:
    problems = check_program(PROGRAM.format(statement=statement))
    assert len(problems) == 1, problems
    assert problem in problems[0].text
    assert problems[0].line in {7, 8}


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("import fractus\ndef f(drone, control): pass\nfractus.run(f)", "f is a synchronous function"),
        ("import fractus\nasync def f(drone): pass\nfractus.run(f)", "f must accept drone and control"),
        ("import fractus\nasync def f(d, c, e): pass\nfractus.run(f)", "f must accept drone and control"),
        ("import fractus\nasync def f(d, c): pass\nfractus.run(f(1, 2))", "pass the function without parentheses"),
        ("from fractus import run\nrun()", "needs the program"),
        ("import fractus as f\nasync def g(d): pass\nf.run(g)", "g must accept drone and control"),
        ("def f(:", "syntax error"),
        ("print('hello')", "does not use the SDK"),
    ],
)
def test_program_that_cannot_start_is_reported(source: str, problem: str) -> None:
    assert [problem in found.text for found in check_program(source)] == [True]


@pytest.mark.parametrize(
    "statement",
    [
        "await asyncio.gather(drone.hover(), asyncio.sleep(1))",
        "leg = drone.goto(1, 2, 3)\n    await leg",
        "async for step in drone.goto(1, 2, 3): print(step)",
        "async with asyncio.TaskGroup() as tasks: tasks.create_task(control.report(1))",
        "await asyncio.to_thread(time.sleep, 1)",
        "while True: await asyncio.sleep(1)",
        "async for health in drone.watch.health(): break",
        "arguments = (1, 2, 3)\n    await drone.goto(*arguments)",
        "print(control.task.path, control.waypoints_reached)",
    ],
)
def test_correct_statement_has_no_problem(statement: str) -> None:
    assert check_program(PROGRAM.format(statement=statement)) == []


def test_examples_and_program_of_the_documentation_have_no_problem() -> None:
    sources = [path.read_text() for path in ROOT.glob("examples/*/*navigator.py")]
    blocks = (ROOT / "docs" / "sdk.md").read_text().split("```python\n")[1:]
    sources.append(textwrap.dedent(blocks[0].partition("```")[0]))
    assert len(sources) >= 4
    assert [check_program(source) for source in sources] == [[]] * len(sources)


def test_check_command_prints_problems_and_exits_with_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program = tmp_path / "patrol.py"
    program.write_text(PROGRAM.format(statement="drone.takeoff(20)"))
    assert run(["check", str(program)]) == 2
    assert f"{program}:7: takeoff is not awaited" in capsys.readouterr().out
    program.write_text(PROGRAM.format(statement="await drone.takeoff(20)"))
    assert run(["check", str(program)]) == 0
    assert capsys.readouterr().out == "no problem found\n"
