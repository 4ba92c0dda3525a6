# SPDX-License-Identifier: Apache-2.0
"""Platform time of one decision: everything but the world model, the policy's own computation and rendering.

Eight candidates of fourteen imagined panoramas (576x1024), one 384x384 view each, from a mock model that hands out
frames made beforehand: once by the planner's calls alone, once as `wiw.Agent.decide`, with all Python in between. The
peers do the same in Python with a look-up cached as well as they allow, one candidate after another: roll the real
panorama for leading turns, cut a view out of every frame, pick the best.
"""

from __future__ import annotations

import numpy as np
from harness import measure, optional, report, spread

import wiw
from wiw._core import core, planner
from wiw.types import Goal, Key, Observation, Proposal

PANORAMA = (576, 1024)
VIEW = (384, 384)
CANDIDATES, STEPS = 8, 14
TARGET_MS = 30.0


def distinct_plans(rng: np.random.Generator) -> list[np.ndarray]:
    """The worst case: no leading turns, nothing in common."""
    plans = rng.integers(1, 4, (CANDIDATES, STEPS)).astype(np.int8)
    plans[:, 0] = 1
    plans[:, 1:4] = np.array([[(i >> bit & 1) + 1 for bit in range(3)] for i in range(CANDIDATES)])
    return list(plans)


def usual_plans() -> list[np.ndarray]:
    """Headings around the agent: some turns, then straight ahead; one proposed twice."""
    headings = [0, 1, 2, 3, -1, -2, -3, 1]
    return [np.array([2 if h > 0 else 3] * abs(h) + [1] * (STEPS - abs(h)), np.int8) for h in headings]


class Decision:
    """What the loop does around the model: build the batch, observations, seeds, views, selection."""

    def __init__(self, plans: list[np.ndarray], panorama: np.ndarray, spec: planner.ModelSpec) -> None:
        self.plans, self.panoramas, self.spec = plans, panorama[None], spec
        self.conditioning = planner.ViewMaker("panorama", PANORAMA)
        self.maker = planner.ViewMaker("front", VIEW)
        self.scores = np.random.default_rng(1).random((1, len(plans)))
        rng = np.random.default_rng(2)
        self.rollouts = [
            rng.integers(0, 256, (len(part.rows), part.steps + 1, *PANORAMA, 3), dtype=np.uint8)
            for part in planner.Batch.build([plans], spec).parts
        ]

    def __call__(self) -> np.ndarray:
        batch = planner.Batch.build([self.plans], self.spec)
        seeds = [core.fold_key([0, 0, 0, candidate]) for candidate in batch.row_owner.tolist()]
        observations = batch.observations(self.panoramas, self.conditioning)
        assert len(seeds) == len(observations)
        assert all(len(part.trajectories) == len(part.rows) for part in batch.parts)
        views = batch.views(self.panoramas, self.rollouts, self.maker)
        return views[int(np.argmax(self.scores[0]))]


def whole_decision(decision: Decision):
    """The same through the agent, with a policy and a model that cost nothing."""

    class Fixed(wiw.Policy):
        def propose(self, situations, candidates, horizon):
            return [[Proposal(plan) for plan in decision.plans] for _ in situations]

        def score(self, situations, proposals, rollouts):
            return list(decision.scores)

    class Mock(wiw.WorldModel):
        accepts = wiw.accepts(control="action", causal=decision.spec.causal)

        def rollout(self, observations, controls, seeds):
            return next(frames for frames in decision.rollouts if frames.shape[1] == len(controls[0].actions) + 1)

    agent = wiw.Agent(Fixed(), Mock(), candidates=CANDIDATES, horizon=STEPS)
    front = np.zeros((480, 480, 3), np.uint8)
    observation = Observation(decision.panoramas[0], front, np.zeros(3))
    return lambda: agent.decide(observation, Goal("imagenav", image=front), Key(seed=0, episode=0))


def one_by_one(decision: Decision, cut):
    """The same decision in plain Python: every candidate has its own rollout of all its steps."""
    frames = decision.rollouts[0].reshape(-1, *PANORAMA, 3)

    def run() -> np.ndarray:
        shown = []
        for m, plan in enumerate(decision.plans):
            leading = next((k for k, a in enumerate(plan) if a == 1), len(plan))
            sign = 1 if plan[0] == 2 else -1
            real = [np.roll(decision.panoramas[0], sign * 64 * (k + 1), axis=1) for k in range(leading)]
            imagined = [frames[(m * STEPS + k) % len(frames)] for k in range(leading, STEPS)]
            shown.append(np.stack([cut(frame) for frame in real + imagined]))
        return shown[int(np.argmax(decision.scores[0]))]

    return run


def remap_cut(cv2):
    """cv2.remap with fixed-point maps made once, the fastest way OpenCV has."""
    focal = VIEW[1] / 2
    x, y = np.meshgrid((np.arange(VIEW[1]) + 0.5) / focal - 1, (np.arange(VIEW[0]) + 0.5) / focal - 1)
    u = (np.arctan2(x, 1) / (2 * np.pi) + 0.5) * PANORAMA[1] - 0.5
    v = (0.5 + np.arctan2(y, np.hypot(x, 1)) / np.pi) * PANORAMA[0] - 0.5
    maps = cv2.convertMaps(u.astype(np.float32), v.astype(np.float32), cv2.CV_16SC2)
    return lambda frame: cv2.remap(frame, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def compare(title: str, decision: Decision) -> None:
    cv2, py360convert = optional("cv2"), optional("py360convert")
    cases = {
        "planner alone": decision,
        "wiw.Agent.decide": whole_decision(decision),
        "cv2.remap, cached maps": one_by_one(decision, remap_cut(cv2)) if cv2 else None,
        "py360convert.e2p": one_by_one(decision, lambda frame: py360convert.e2p(frame, 90, 0, 0, VIEW))
        if py360convert
        else None,
    }
    timings = measure(cases, repeats=15)
    ours = timings["wiw.Agent.decide"]
    report(title, cases, timings, "wiw.Agent.decide", f"p50 at most {TARGET_MS:g} ms")
    verdict = "met" if np.median(ours.wall) * 1e3 <= TARGET_MS else "MISSED"
    print(f"  platform time per decision: {spread(1e3 * ours.wall)} ms, target {verdict}")


def main() -> None:
    rng = np.random.default_rng(0)
    panorama = rng.integers(0, 256, (*PANORAMA, 3), dtype=np.uint8)
    worst = Decision(distinct_plans(rng), panorama, planner.ModelSpec())
    usual = Decision(usual_plans(), panorama, planner.ModelSpec(causal=True))
    compare(f"{CANDIDATES} candidates x {STEPS} frames, nothing in common", worst)
    compare(f"{CANDIDATES} candidates x {STEPS} frames, headings with leading turns, causal model", usual)


if __name__ == "__main__":
    main()
