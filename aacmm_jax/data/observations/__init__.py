"""Kinds of observations, one file each: what ties the tip down.

>>> import numpy as np
>>> import aacmm_jax as aj
>>> q = np.linspace(0.0, 1.0, 60).reshape(10, 6)  # joint readings, rad: a row for each pose
>>> seen = np.linspace(100.0, 900.0, 30).reshape(10, 3)  # mm, in the frame of an instrument
>>> tracker = aj.data.observations.MeasuredPoints("tracker", q, seen, u=0.015, target="reflector")
>>> sphere = aj.data.observations.Sphere("sphere", q, diameter=25.0, u=0.0005, stylus=6.0)
>>> bar = aj.data.observations.Artefact("bar", {"a": (0, 0, 0), "b": (300, 0, 0)}, {"a": q[:5], "b": q[5:]}, u=0.001)
>>> capture = aj.Capture({}, observations=[tracker, sphere, bar])
>>> [list(observation.unknowns) for observation in capture.observations]
[['frame of tracker'], ['centre of sphere', 'radius of sphere'], ['placement bar', 'coordinates of bar']]

``aj.calibrate(arm, capture, bounds)`` finds these unknowns together with the arm; ``Simulated...`` of each kind is what
``aj.simulate(arm, {}, observations=[...])`` records.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
