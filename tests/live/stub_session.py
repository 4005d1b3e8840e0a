"""A session that is made up: an arm that moves between sockets, for tests of the page and its server."""

import math
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.kinematics.chain import forward_pass, joint_motion


class StubSession:
    """Keeps what it was asked for in ``asked``; ``text`` is what a device would say."""

    def __init__(self, arm: str = "panda", text: str = "ok", poses: int = 0, places: int = 4):
        self.arm, self.text, self.asked, self.lock = aj.load_arm(arm), text, [], threading.Lock()
        self.geometry, self.began, self.version = to_numpy(self.arm.geometry), time.monotonic(), 1
        rng = np.random.default_rng(0)
        self.home = rng.uniform(-0.8, 0.8, self.arm.joints)
        self.places = [
            {"name": f"{text[:40]} {chr(65 + i)}" if text != "ok" else chr(65 + i), "kind": "socket", "poses": 0,
             "position": list(self.links(self.home + rng.uniform(-0.7, 0.7, self.arm.joints))[-1]), "wanted": 12}
            for i in range(places)
        ]  # fmt: skip
        self.poses: list[dict[str, Any]] = []
        self.auto_on, self.celsius, self.session, self.done, self.here = True, 20.0, 1, False, None
        self.written: Path | None = None  # the report
        for _ in range(poses):
            self.take()
        self.asked.clear()

    def links(self, q: np.ndarray) -> list[list[float]]:
        forward = forward_pass(self.geometry, joint_motion(self.geometry, q[None]))
        return [[float(x) for x in np.ravel(p)] for p in (*forward.origin_before, forward.tip)]

    def now(self) -> np.ndarray:
        t = time.monotonic() - self.began
        return self.home + 0.3 * np.sin(0.7 * t + np.arange(self.arm.joints))

    def report(self) -> Path | None:
        return self.written

    def __getattr__(self, name: str) -> Any:
        if name not in ("mark", "temperature", "auto", "place", "finish", "undo", "exclude", "take", "skip"):
            raise AttributeError(name)

        def do(**fields: Any) -> None:
            with self.lock:
                self.asked.append((name, fields))
                self.version += 1
                getattr(self, f"_{name}")(**fields)

        return do

    def _take(self) -> None:
        number, place = len(self.poses) + 1, self.places[len(self.poses) % len(self.places)]
        rng = np.random.default_rng(number)
        residual = rng.normal(0, 0.02, 3) * (12 if number % 17 == 0 else 1)
        self.poses.append(
            {"number": number, "place": place["name"], "time": time.time(), "session": self.session,
             "residual_mm": float(np.linalg.norm(residual)), "expected_mm": 0.034, "outlier": number % 17 == 0,
             "excluded": False, "tip": place["position"], "residual": list(residual)}
        )  # fmt: skip
        place["poses"] += 1

    def _undo(self) -> None:
        if not self.poses:
            raise aj.InputError("there is no pose to undo")
        gone = self.poses.pop()
        next(place for place in self.places if place["name"] == gone["place"])["poses"] -= 1

    def _skip(self) -> None:
        pass

    def _exclude(self, pose: int, excluded: bool) -> None:
        self.poses[pose - 1]["excluded"] = excluded

    def _mark(self, text: str) -> None:
        self.session += 1

    def _temperature(self, celsius: float) -> None:
        self.celsius = celsius

    def _auto(self, on: bool) -> None:
        self.auto_on = on

    def _place(self, name: str) -> None:
        self.here = name

    def _finish(self, calibrate: bool) -> None:
        self.done = True

    def state(self, since: int | None = None) -> dict[str, Any]:
        with self.lock:
            q, t = self.now(), time.monotonic() - self.began
            links = self.links(q)
            device = {"name": "simulated:panda", "connected": True, "lines": int(100 * t), "bad": {"wrong checksum": 3}}
            live = {
                "q": list(np.rad2deg(q)), "links": links, "tip": links[-1],
                "still": t % 4 > 2, "since": max(t % 4 - 2, 0), "rate": 100.0,
                "place": self.here, "devices": [device | {"message": self.text}],
            }  # fmt: skip
            sound = len(self.poses)
            if since == self.version:
                return {"version": self.version, "live": live, "sound": sound}
            n, target = max(len(self.poses), 1), self.places[sound % len(self.places)]
            words = ["The arm was calibrated; U of a length is 0.12 mm.", self.text] if self.done else []
            paths = ["capture.h5", "capture-report.html"] if self.done else []
            joints = [{"name": f"joint {i + 1}", "kind": "revolute", "unit": "deg"} for i in range(len(q))]
            return {
                "version": self.version, "live": live, "sound": sound, "auto": self.auto_on, "session": self.session,
                "temperature": self.celsius, "busy": None, "message": "", "stop": False,
                "headline": f"Put the tip into {target['name']}", "arm": {"name": "panda", "joints": joints},
                "places": self.places, "poses": self.poses, "sentences": words, "paths": paths,
                "next": {"place": target["name"], "q": list(q), "links": self.links(self.home - 0.4), "distance": 0.4,
                         "why": "It determines theta_5 and the probe best; come from below."},
                "progress": {"u_length_mm": 1.2 / math.sqrt(n), "u_after_ten_mm": 1.2 / math.sqrt(n + 10),
                             "u_target_mm": 0.2, "limits": "More poses lower U; 23 more are needed."},
            }  # fmt: skip
