# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError
from wiw.nav import NavMesh
from wiw.render import Renderer
from wiw.runs.scene_map import HFOV_DEG, draw, look_down, to_pixels
from wiw.scenes import load
from wiw.types import ArmObservation, Decision, Goal, Key, Observation, Proposal, Rollout
from wiw.viz.contact_sheet import GAP, HEIGHT


def decision(frames=(5, 60, 60, 3), observation=True):
    panorama = np.full((72, 128, 3), 90, np.uint8)
    rollouts = tuple(Rollout(np.full(frames, 40 * i, np.uint8), np.arange(5) < i) for i in range(2))
    return Decision(
        np.array([1, 1, 2]),
        2,
        (Proposal([1, 1, 2, 2, 2]), Proposal([2, 1, 1, 1, 1])),
        rollouts,
        np.array([0.2, 0.7]),
        1,
        Observation(panorama, panorama, np.zeros(3)) if observation else None,
        Goal("imagenav", image=panorama),
    )


@pytest.mark.parametrize("frames", [(5, 60, 60, 3), (5, 64, 128, 3), (5, 3, 60, 60, 3)])
def test_show_draws_every_frame_and_marks_the_choice(frames):
    figure = wiw.show(decision(frames))
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles.count("real, turned") == 1 and sum(title.startswith("imagined") for title in titles) == 9
    assert sum("chosen" in text.get_text() for axes in figure.axes for text in axes.texts) == 1
    assert figure._repr_png_()[:4] == b"\x89PNG"


def test_show_writes_dollars_of_a_goal_as_they_are():
    one = replace(decision(), goal=Goal("aeqa", text="Is it $^$?"))
    assert wiw.show(one)._repr_png_()[:4] == b"\x89PNG"


def test_show_draws_plans_of_poses():
    pose = np.array([0.2, 0.0, 1.0, np.pi, 0, 0, 1.0])
    plan = np.array([[0, 0, -0.1, 0, 0, 0, -1.0], [0, 0.1, -0.1, 0, 0, 0, -1.0]]) + pose
    seen = ArmObservation(np.full((48, 48, 3), 90, np.uint8), pose)
    rollout = Rollout(np.full((2, 48, 48, 3), 40, np.uint8), np.zeros(2, bool))
    one = Decision(plan, 2, (Proposal(plan),), (rollout,), np.zeros(1), 0, seen, Goal("dot", text="go there"))
    figure = wiw.show(one)
    assert "↧● →" in {text.get_text() for axes in figure.axes for text in axes.texts}
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles.count("seen from the front") == 1 and sum(title.startswith("imagined") for title in titles) == 2
    with pytest.raises(ArgumentError, match=r"env\.unwrapped\.observation"):
        wiw.Agent("scripted").decide(seen.as_dict(), Goal("dot"), Key(0, 0))


def test_show_needs_an_observation():
    with pytest.raises(ArgumentError, match="contains no observation"):
        wiw.show(decision(observation=False))


PILLAR = """o floor
v -2 0 -3
v 2 0 -3
v 2 0 3
v -2 0 3
f 1 4 3 2
o pillar
v 0.9 0.5 -1.1
v 1.1 0.5 -1.1
v 1.1 0.5 -0.9
v 0.9 0.5 -0.9
f 5 8 7 6
"""


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "pillar.obj").write_text(PILLAR)
    return load(tmp_path / "pillar.obj")


def test_the_map_puts_things_where_they_are(scene):
    view = look_down(np.asarray(scene.bounds, np.float64), 0.0)
    depth = Renderer(scene, backend="cpu").perspective(view.T_world_camera[None], view.size, HFOV_DEG)["depth"][0]
    above = view.T_world_camera[1, 3]
    for point, height in (((1, 0, -1), 0.5), ((-1, 0, -1), 0.0), ((1, 0, 1), 0.0)):
        ((u, v),) = np.floor(to_pixels(view.world_to_pixel, [point])).astype(int)
        assert depth[v, u] == pytest.approx(above - height, abs=1e-3)


def test_the_map_is_transparent_outside_the_scene(scene):
    image, matrix = draw(scene, NavMesh.build(scene), 0.0, "cpu")
    ((u, v), (u_out, v_out)) = np.floor(to_pixels(matrix, [[0, 0, 0], [2.3, 0, 0]])).astype(int)
    assert image[v, u, 3] == 255 and image[v_out, u_out, 3] == 0


def test_a_roof_that_cannot_be_lifted_gives_way_to_the_navigation_mesh(tmp_path):
    roofed = tmp_path / "roofed.obj"
    roofed.write_text("""o house
v -2 0 -3
v 2 0 -3
v 2 0 3
v -2 0 3
v -2 3 -3
v 2 3 -3
v 2 3 3
v -2 3 3
f 1 4 3 2
f 5 8 7 6
""")
    house = load(roofed)
    image, _ = draw(house, NavMesh.build(house), 0.0, "cpu")
    assert {tuple(color) for color in image.reshape(-1, 4)} == {(236, 233, 226, 255), (0, 0, 0, 0)}


def test_a_sheet_has_as_many_panoramas_as_asked_for_in_any_file(two_rooms, tmp_path, capsys):
    widths = []
    for views in (0, 1, 2):
        sheet = tmp_path / f"{views}.psd"  # which Pillow reads, but does not write
        assert main(["scenes", two_rooms, "--views", str(views), "--backend", "cpu", "--out", str(sheet)]) == 0
        widths.append(Image.open(sheet).width)
    assert np.diff(widths).tolist() == [HEIGHT * 16 // 9 + GAP] * 2
