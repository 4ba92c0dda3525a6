# SPDX-License-Identifier: Apache-2.0
"""The environments in gymnasium's own registry."""

from __future__ import annotations

import subprocess
import sys

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env

import wiw
from wiw.errors import ArgumentError
from wiw.gymnasium_ids import NAMESPACE, list_ids


@pytest.mark.parametrize("imports", ["import wiw, gymnasium", "import gymnasium, wiw", "import wiw, gymnasium.spaces"])
def test_importing_both_in_any_order_registers_them(imports: str) -> None:
    code = f"{imports}; import sys; names = {{*sys.modules['gymnasium'].registry}}; "
    code += (
        "sys.exit(not {'wiw/ImageNav-v0', 'wiw/AR-v0', 'wiw/Manipulation-v0'} <= names or 'wiw.envs' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_importing_wiw_leaves_gymnasium_alone() -> None:
    code = "import wiw, sys; sys.exit('gymnasium' in sys.modules or 'wiw._core' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_task_is_there() -> None:
    ids = {"ImageNav-v0": "imagenav", "AR-v0": "ar", "AEQA-v0": "aeqa", "Manipulation-v0": "manipulation"}
    assert list_ids() == ids and {*ids.values()} == {*wiw.registry.TASKS.built_in}
    assert {f"{NAMESPACE}/{name}" for name in ids} <= set(gymnasium.registry)
    assert {name: wiw.registry.task_name(name) for name in ids} == ids


def test_gymnasium_makes_what_wiw_makes(two_rooms: str) -> None:
    env = gymnasium.make("wiw/ImageNav-v0", scenes=two_rooms, seed=3, depth=False, render_mode="rgb_array")
    ours = wiw.make("ImageNav-v0", scenes=two_rooms, seed=3, depth=False)
    assert env.unwrapped.task.describe() == ours.task.describe()
    observation, _ = env.reset(options={"episode": 1})
    assert (observation["front"] == ours.reset(options={"episode": 1})[0]["front"]).all()
    assert (env.render() == ours.render()).all()
    vector = gymnasium.make_vec(
        "wiw/ImageNav-v0", num_envs=2, vectorization_mode="vector_entry_point", scenes=two_rooms, depth=False
    )
    assert vector.num_envs == 2 and isinstance(vector.unwrapped, wiw.envs.VectorEnv)
    with pytest.raises(ArgumentError, match="render_mode: expected 'rgb_array', got 'human'"):
        gymnasium.make("wiw/ImageNav-v0", scenes=two_rooms, render_mode="human")


def test_the_checker_of_gymnasium_passes_them(two_rooms: str) -> None:
    check_env(gymnasium.make("wiw/ImageNav-v0", scenes=two_rooms).unwrapped)
    check_env(gymnasium.make("wiw/Manipulation-v0", tasks="push_buttons", size=32).unwrapped)
