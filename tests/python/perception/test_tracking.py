# SPDX-License-Identifier: Apache-2.0
"""Trackers against true renders, boxes across the seam, and the views that are cut around them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, to_viewpoints
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import world
from wiw.envs.pointing import Pointing
from wiw.errors import ArgumentError, WeightsError
from wiw.panorama import directions, rotate, to_perspective
from wiw.perception.boxes import box_width, find_box, keep_largest_part, scale_box
from wiw.perception.flow import Flow
from wiw.perception.frame_tracking import FrameTracker
from wiw.perception.growing import Growing, grow_mask
from wiw.perception.tracking import Reprojection, Tracker, remove_specks, reproject_masks, track_rollouts
from wiw.perception.views import cut_target_views
from wiw.registry import TRACKERS
from wiw.types import Observation, Proposal, Rollout, Target

PLAN = np.array([FORWARD, TURN_LEFT, FORWARD, FORWARD, TURN_RIGHT, FORWARD], np.int8)


def look(place: Any, position: Any, yaw: float, name: str, poses: Any = None) -> tuple[Observation, Any, Any]:
    """An observation that points a thing out, and true frames and masks from poses relative to it."""
    thing = next(int(i["id"]) for i in place.scene.instances if i["name"] == name)
    start = camera_pose(np.asarray(position, float), yaw)
    cameras = np.concatenate([start[None], start @ (to_viewpoints(PLAN) if poses is None else poses)])
    shown = place.renderer.panorama(cameras)
    front = place.renderer.perspective(start[None], (480, 480), 90.0)
    target = Pointing().target(shown["instance"][0], front["instance"][0], thing)
    observation = Observation(shown["color"][0], front["color"][0], np.zeros(3), shown["depth"][0], target)
    return observation, shown["color"][1:], shown["instance"][1:] == thing


def overlap(a: Any, b: Any) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


def make_box_mask(box: Any, columns: int = 1024) -> Any:
    """The box as a mask."""
    filled = np.zeros((576, columns), bool)
    left, top, right, bottom = (round(edge) for edge in box)
    filled[top:bottom, (left + np.arange(round(box_width(box, columns)))) % columns] = True
    assert right % columns == (left + round(box_width(box, columns))) % columns
    return filled


@pytest.mark.parametrize(
    ("position", "yaw", "name"),
    [((-1.2, 0, -1.0), 0.3, "table"), ((-1.2, 0, -1.0), 3.0, "table"), ((1.5, 0, 0.5), 0.0, "chest")],
)
def test_reprojected_boxes_are_where_true_ones_are(two_rooms: str, position: Any, yaw: float, name: str) -> None:
    observation, frames, truth = look(world(two_rooms), position, yaw, name)
    track = Reprojection().track([observation], [to_viewpoints(PLAN)], [frames])[0]
    agreement = [
        overlap(make_box_mask(box), make_box_mask(find_box(mask, wraps=True)))
        for box, mask in zip(track.boxes, truth, strict=True)
    ]
    assert min(agreement) > 0.7
    assert np.median(agreement) > 0.85


def test_what_is_hidden_in_the_new_view_is_not_marked(two_rooms: str) -> None:
    place = world(two_rooms)
    aside = np.tile(np.eye(4), (8, 1, 1))
    aside[:, 0, 3] = -0.04 * np.arange(1, 9)  # to the left, behind the wall beside the door
    observation, frames, truth = look(place, (-1.0, 0, 1.2), -np.pi / 2, "shelf", aside)
    track = Reprojection().track([observation], [aside], [frames])[0]
    seen = truth.reshape(8, -1).sum(axis=1)
    assert observation.target.mask.sum() > 2 * seen[-1]  # it does get hidden
    for marked, true in zip(track.masks, truth, strict=True):
        assert (marked & ~true).sum() <= 80  # a column of pixels at the rim; the whole shelf has 1400
    assert track.visible[:3].all()
    assert not track.visible[seen == 0].any()


def test_what_comes_into_sight_is_grown_into(two_rooms: str) -> None:
    aside = np.tile(np.eye(4), (8, 1, 1))
    aside[:, 0, 3] = 0.04 * np.arange(1, 9)  # out from behind the wall beside the door
    observation, frames, truth = look(world(two_rooms), (-1.0, 0, 1.05), -np.pi / 2, "shelf", aside)
    plain, more = (tracker.track([observation], [aside], [frames])[0] for tracker in (Reprojection(), Growing()))
    boxes = [
        [overlap(make_box_mask(b), make_box_mask(find_box(t, True))) for b, t in zip(x.boxes, truth, strict=True)]
        for x in (plain, more)
    ]
    assert np.mean(boxes[0]) < 0.5
    assert np.mean(boxes[1]) > 0.8
    again = Growing().track([observation], [aside], [frames])[0]
    np.testing.assert_array_equal(more.masks, again.masks)


@given(st.integers(0, 2**32 - 1), st.integers(0, 63), st.booleans())
@settings(max_examples=25)
def test_growth_keeps_the_seed_and_stays_in_what_was_not_seen(seed: int, shift: int, wraps: bool) -> None:
    rng = np.random.default_rng(seed)
    frame = rng.integers(0, 255, (32, 64, 3), np.uint8)
    own, unseen = np.zeros((32, 64), bool), np.zeros((32, 64), bool)
    own[12:18, 20:26] = True
    unseen[10:20, 26:36] = True
    frame[own | unseen] = frame[own | unseen] // 8
    found = grow_mask(*(np.roll(part, shift, axis=1) for part in (frame, own, unseen)), wraps)
    found = np.roll(found, -shift, axis=1)
    assert (found & own).sum() == own.sum()
    assert not (found & ~own & ~unseen).any()
    if wraps:
        np.testing.assert_array_equal(found, grow_mask(frame, own, unseen, wraps))


def test_a_target_that_fills_the_frame_but_for_a_rim_is_left_as_it_is() -> None:
    """Near a target no pixel is left to be background."""
    frame = np.random.default_rng(0).integers(0, 255, (480, 480, 3), np.uint8)
    own = np.zeros((480, 480), bool)
    own[6:-6, 6:-6] = True
    np.testing.assert_array_equal(grow_mask(frame, own, ~own, wraps=False), own)


def test_a_hairline_is_no_sight_of_a_target() -> None:
    masks = np.zeros((3, 6, 8), bool)
    masks[0, 1:5, 3] = masks[1, 2, 1:6] = masks[2, 1:5, 3:5] = True
    np.testing.assert_array_equal(remove_specks(masks).any(axis=(1, 2)), [False, False, True])


def test_a_lost_target_has_no_box(two_rooms: str) -> None:
    observation, frames, _ = look(world(two_rooms), (-1.2, 0, -1.0), 0.3, "table")
    gone = replace(observation, target=Target(np.zeros((576, 1024), bool), None, None))
    track = Reprojection().track([gone], [to_viewpoints(PLAN)], [frames])[0]
    assert track.boxes == (None,) * 6
    assert not track.masks.any()
    assert not track.visible.any()


def test_front_views_are_tracked_too(two_rooms: str) -> None:
    place = world(two_rooms)
    thing = next(int(i["id"]) for i in place.scene.instances if i["name"] == "table")
    position, yaw = (-1.2, 0, -0.2), np.pi / 2 - 0.5
    observation, _, _ = look(place, position, yaw, "table")
    poses = to_viewpoints(PLAN[:3])
    cameras = camera_pose(np.asarray(position, float), yaw) @ poses
    shown = place.renderer.perspective(cameras, (384, 384), 90.0)
    track = Reprojection().track([observation], [poses], [shown["color"]], panoramic=False)[0]
    for marked, ids in zip(track.masks, shown["instance"], strict=True):
        assert overlap(marked, ids == thing) > 0.7


def test_rows_do_not_depend_on_what_else_is_tracked(two_rooms: str) -> None:
    one, frames, _ = look(world(two_rooms), (-1.2, 0, -1.0), 0.3, "table")
    other, _, _ = look(world(two_rooms), (1.5, 0, 0.5), 0.0, "chest")
    plans = [Proposal(PLAN), Proposal(PLAN[:2])]
    futures = [[Rollout(frames[: len(plan.actions)], np.zeros(1, bool), "panorama") for plan in plans]] * 2
    tracks = track_rollouts(Reprojection(), [one, other], [plans, plans], futures)
    for observation, row in zip((one, other), tracks, strict=True):
        for plan, track in zip(plans, row, strict=True):
            viewpoints = to_viewpoints(plan.actions)
            alone = Reprojection().track([observation], [viewpoints], [frames[: len(viewpoints)]])[0]
            np.testing.assert_array_equal(track.masks, alone.masks)
            assert track.boxes == alone.boxes
    with pytest.raises(ArgumentError, match="all 'panorama' or all 'front'"):
        track_rollouts(Reprojection(), [one], [plans[:1]], [[Rollout(frames[:6, None], np.zeros(6, bool), "surround")]])


def test_several_masks_are_moved_at_once_as_one_by_one(two_rooms: str) -> None:
    observation, frames, _ = look(world(two_rooms), (-1.2, 0, -1.0), 0.3, "table")
    poses = to_viewpoints(PLAN[:3])
    masks = np.stack([np.roll(observation.target.mask, shift, axis=1) for shift in (0, 200, 400, 600)])
    together, _ = reproject_masks(masks, observation.depth, poses, (576, 1024))
    for mask, moved in zip(masks, together, strict=True):
        alone = replace(observation, target=replace(observation.target, mask=mask))
        tracked = Reprojection().track([alone], [poses], [frames[:3]])[0].masks
        np.testing.assert_array_equal(remove_specks(moved), tracked)
    assert together.any(axis=(1, 2, 3)).all()


def test_a_tracker_says_what_it_lacks(two_rooms: str) -> None:
    observation, frames, _ = look(world(two_rooms), (-1.2, 0, -1.0), 0.3, "table")
    viewpoints = to_viewpoints(PLAN)
    for changed, message in (
        (replace(observation, depth=None), "needs depth"),
        (replace(observation, target=None), "an observation with a target"),
    ):
        with pytest.raises(ArgumentError, match=message):
            Reprojection().track([changed], [viewpoints], [frames])
    with pytest.raises(ArgumentError, match=r"viewpoints \[K, 4, 4\]"):
        Reprojection().track([observation], [viewpoints[:2]], [frames])
    assert isinstance(TRACKERS.make("reprojection"), Tracker)


# -- trackers that look at the frames ----------------------------------------------------------------------------------


class Recorder(FrameTracker):
    """Keeps what it is asked to follow, and finds the target where it was first."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, Any, Any]] = []

    def follow(self, views: Any, masks: Any, frames: Any) -> Any:
        self.asked.append((views, masks, frames))
        return np.repeat(masks[:1], len(frames), axis=0)


def imagine_nothing(observation: Observation, actions: Any, front: bool = False) -> tuple[Proposal, Rollout]:
    """A plan and the frames of a model that ignores it: after the real leading turns all stands still."""
    plan, turns = Proposal(actions), 0
    while turns < len(plan.actions) and plan.actions[turns] == TURN_LEFT:
        turns += 1
    panoramas = [rotate(observation.panorama, 22.5 * min(k, turns)) for k in range(1, len(plan.actions) + 1)]
    frames = np.stack([to_perspective(each, 90.0, (384, 384)) if front else each for each in panoramas])
    real = np.arange(len(frames)) < turns
    return plan, Rollout(frames, real, "front" if front else "panorama")


def track_one(tracker: Tracker, observation: Observation, plan: Proposal, rollout: Rollout) -> Any:
    return track_rollouts(tracker, [observation], [[plan]], [[rollout]])[0][0]


@pytest.mark.parametrize("front", [False, True])
@pytest.mark.parametrize("turns", [0, 1])
def test_the_box_stays_on_a_thing_that_stands_still_though_the_plan_moves(
    two_rooms: str, front: bool, turns: int
) -> None:
    yaw = np.pi / 2 - 0.3 - turns * np.pi / 8
    observation, _, _ = look(world(two_rooms), (-1.2, 0, -0.2), yaw, "table")
    plan, rollout = imagine_nothing(observation, [TURN_LEFT] * turns + [FORWARD, FORWARD, TURN_RIGHT, FORWARD], front)
    start = rotate(observation.target.mask.astype(np.uint8), 22.5 * turns)
    start = (to_perspective(start, 90.0, (384, 384), interpolation="nearest") if front else start) > 0
    looked, told = (track_one(tracker, observation, plan, rollout) for tracker in (Flow(), Reprojection()))
    assert looked.visible.all()
    for mask in looked.masks[turns:]:
        assert overlap(mask, start) > 0.97
    assert overlap(told.masks[-1], start) < 0.3, "geometry says where the plan would have led"
    if turns:
        assert overlap(looked.masks[0], start) > 0.99, "a real frame"


@pytest.mark.parametrize(("position", "yaw", "name"), [((-1.2, 0, -1.0), 3.0, "table"), ((1.5, 0, 0.5), 0.0, "chest")])
def test_true_frames_are_followed_by_their_pixels(two_rooms: str, position: Any, yaw: float, name: str) -> None:
    observation, frames, truth = look(world(two_rooms), position, yaw, name)
    blind = replace(observation, depth=None)
    track = Flow().track([blind], [np.tile(np.eye(4), (len(PLAN), 1, 1))], [frames])[0]
    agreement = [overlap(mask, true) for mask, true in zip(track.masks, truth, strict=True)]
    assert min(agreement) > 0.8


def test_a_frame_that_shows_something_else_has_no_box(two_rooms: str) -> None:
    observation, _, _ = look(world(two_rooms), (-1.2, 0, -0.2), np.pi / 2 - 0.3, "table")
    elsewhere, _, _ = look(world(two_rooms), (1.5, 0, 0.5), 0.0, "chest")
    poses = [np.tile(np.eye(4), (4, 1, 1))]
    noise = np.random.default_rng(0).integers(0, 255, observation.panorama.shape, np.uint8)
    frames = np.stack([noise, np.full_like(noise, 90), elsewhere.panorama, observation.panorama])
    track = Flow().track([observation], poses, [frames])[0]
    assert track.visible.tolist() == [False, False, False, True], "it is found again where it comes back"
    assert not track.masks[:3].any()
    gone = replace(observation, target=Target(np.zeros((576, 1024), bool), None, None))
    assert not Flow().track([gone], poses, [frames])[0].visible.any()


def test_panoramas_are_followed_from_after_the_real_turns_with_the_target_in_the_middle(two_rooms: str) -> None:
    observation, _, _ = look(world(two_rooms), (-1.2, 0, -1.0), 0.3, "table")
    tracker = Recorder()
    plan, rollout = imagine_nothing(observation, [TURN_LEFT, TURN_LEFT, FORWARD, FORWARD])
    track = track_one(tracker, observation, plan, rollout)
    ((views, masks, frames),) = tracker.asked
    assert len(views) == len(masks) == 1 and len(frames) == 2
    np.testing.assert_array_equal(views[0], frames[0])  # nothing moves but by the real turns
    box = find_box(masks[0])
    assert abs((box[0] + box[2]) / 2 - 512) <= 1
    for turns, mask in zip((1, 2, 2, 2), track.masks, strict=True):
        turned = rotate(observation.target.mask.astype(np.uint8), 22.5 * turns) > 0
        np.testing.assert_array_equal(mask, turned)


def test_front_views_are_led_up_to_from_one_that_faces_the_target(two_rooms: str) -> None:
    observation, _, _ = look(world(two_rooms), (-1.2, 0, -0.2), -np.pi / 2, "table")
    assert observation.target.front_box is None, "the test needs a target behind the agent"
    tracker = Recorder()
    track_one(tracker, observation, *imagine_nothing(observation, [TURN_LEFT, FORWARD, FORWARD], front=True))
    ((views, masks, frames),) = tracker.asked
    assert len(frames) == 2 and 5 <= len(views) <= 9
    box = find_box(masks[0])
    assert abs((box[0] + box[2]) / 2 - 192) < 8, "the first view faces it"
    assert not masks[-1].any()
    np.testing.assert_array_equal(views[-1], frames[0])
    shift = np.abs(np.diff(views.astype(int), axis=0)).mean(axis=(1, 2, 3))
    assert (shift > 1).all(), "each view is a turn further"


def test_a_target_that_no_front_view_shows_is_lost(two_rooms: str) -> None:
    observation, _, _ = look(world(two_rooms), (-1.2, 0, -0.2), np.pi / 2, "table")
    below = np.zeros((576, 1024), bool)
    below[560:570] = True  # at the agent's feet, under all that a view 90 degrees high shows
    observation, tracker = replace(observation, target=Target(below, find_box(below, wraps=True), None)), Recorder()
    track = track_one(tracker, observation, *imagine_nothing(observation, [TURN_LEFT, FORWARD], front=True))
    assert not tracker.asked and not track.visible.any()


def test_the_tracker_of_frames_is_sam2_only_where_its_weights_are(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    made = TRACKERS.make("frames")
    assert isinstance(made, Flow) and made.describe() == {"name": "Flow", "follows": "frames"} and made.needs == ()
    with pytest.raises(WeightsError, match="no folder"):
        TRACKERS.make("frames", weights=str(tmp_path / "sam2"))  # asked for: nothing takes its place
    (tmp_path / "models--facebook--sam2.1-hiera-tiny/snapshots/abc").mkdir(parents=True)
    (tmp_path / "models--facebook--sam2.1-hiera-tiny/snapshots/abc/config.json").write_text("{}")
    monkeypatch.setattr("wiw.perception.make_tracker.Sam2", lambda **options: ("sam2", options))
    monkeypatch.setattr("wiw.registry.Registry._check_kind", lambda self, name, thing: thing)
    assert TRACKERS.make("frames") == ("sam2", {})


# -- boxes -------------------------------------------------------------------------------------------------------------

columns_filled = st.lists(st.booleans(), min_size=1, max_size=24).map(np.array)


@given(columns_filled)
def test_the_box_on_a_circle_is_the_narrowest_that_holds_the_mask(filled: Any) -> None:
    width = len(filled)
    box = find_box(filled[None], wraps=True)
    if not filled.any():
        assert box is None
        return
    narrowest = min(
        length
        for left in range(width)
        for length in range(1, width + 1)
        if filled.sum() == filled[(left + np.arange(length)) % width].sum()
    )
    inside = (int(box[0]) + np.arange(int(box_width(box, width)))) % width
    assert filled.sum() == filled[inside].sum()
    assert len(inside) == narrowest
    if find_box(filled[None])[2] - find_box(filled[None])[0] == narrowest:
        assert box[0] < box[2]  # the seam is crossed only where that is narrower


@given(st.integers(0, 63), st.integers(1, 63), st.floats(0.5, 3))
def test_a_scaled_box_keeps_its_middle_on_the_circle(left: int, width: int, scale: float) -> None:
    box = (float(left), 10.0, float((left + width - 1) % 64 + 1), 20.0)
    grown = scale_box(box, scale, (40, 64), wraps=True)
    assert box_width(grown, 64) == pytest.approx(min(64, scale * box_width(box, 64)))
    if scale * box_width(box, 64) < 64:
        away = (grown[0] + box_width(grown, 64) / 2) - (box[0] + box_width(box, 64) / 2)
        assert (away + 32) % 64 - 32 == pytest.approx(0, abs=1e-6)
    assert (grown[1], grown[3]) == pytest.approx((max(0, 15 - 5 * scale), 15 + 5 * scale))
    clipped = scale_box((50.0, 10.0, 60.0, 20.0), 3, (40, 64))
    assert clipped == (40.0, 0.0, 64.0, 30.0)


def test_the_largest_part_hangs_together_over_the_seam() -> None:
    mask = np.zeros((12, 40), bool)
    mask[2:5, 36:] = mask[5:8, :3] = True  # they touch at a corner across the seam: 12 + 9
    mask[2:10, 18:20] = True  # 16
    expected = mask.copy()
    expected[:, 18:20] = False
    np.testing.assert_array_equal(keep_largest_part(mask, wraps=True), expected)
    np.testing.assert_array_equal(keep_largest_part(mask), mask & ~expected)


# -- views -------------------------------------------------------------------------------------------------------------


def test_views_look_at_the_target_wherever_it_is() -> None:
    rays = directions((288, 512))
    masks, panoramas = [], []
    for yaw, pitch in ((0, 0), (179.7, -20), (-100, 35), (60, -80)):
        y, p = np.radians([yaw, pitch])
        middle = np.array([-np.sin(y) * np.cos(p), np.sin(p), -np.cos(y) * np.cos(p)])
        mask = rays @ middle > np.cos(np.radians(6))
        masks.append(mask)
        panoramas.append(np.where(mask[..., None], [0, 200, 0], [40, 40, 40]).astype(np.uint8))
    masks.insert(2, np.zeros((288, 512), bool))
    panoramas.insert(2, panoramas[0])
    views = cut_target_views(np.stack(panoramas), np.stack(masks), draw=False)
    assert views.images.shape == (4, 384, 384, 3)
    assert views.frames.tolist() == [0, 1, 3, 4]
    assert views.lost_frames.tolist() == [2]
    for image, (left, top, right, bottom) in zip(views.images, views.boxes, strict=True):
        assert abs((left + right) / 2 - 192) < 8
        assert abs((top + bottom) / 2 - 192) < 16
        assert 36 < right - left < 48  # 12 degrees of 90 in the middle of the view
        assert (image[192, 192] == [0, 200, 0]).all()
    fitted = cut_target_views(np.stack(panoramas), np.stack(masks), (128, 128), "fit")
    assert fitted.hfov_deg.tolist()[:2] == [30, 30]
    left, top, right, bottom = (int(edge) for edge in fitted.boxes[0])
    assert (fitted.images[0, top - 1, left:right] == [220, 40, 40]).all()  # the line lies around the box
    assert (fitted.images[0, (top + bottom) // 2, left + 2] == [0, 200, 0]).all()


def test_no_frame_in_sight_gives_no_view() -> None:
    views = cut_target_views(np.zeros((3, 64, 128, 3), np.uint8), np.zeros((3, 64, 128), bool), (32, 32))
    assert views.images.shape == (0, 32, 32, 3)
    assert (views.boxes, views.frames.tolist(), views.lost_frames.tolist()) == ((), [], [0, 1, 2])
    with pytest.raises(ArgumentError, match="masks"):
        cut_target_views(np.zeros((3, 64, 128, 3), np.uint8), np.zeros((2, 64, 128), bool))
