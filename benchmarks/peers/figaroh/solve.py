"""Calibrate with figaroh and predict held-out points, in its own environment: IN.npz OUT.npz.

figaroh calibrates a URDF against measured points: base frame, tip, and the parameters that it finds identifiable
("structural") or all with a prior ("map"), and if asked for the elasticity of the joints. The robot of its example
classes is a `BaseCalibration` with a cost function of its own; the one below is that of its documentation.
"""

import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pinocchio as pin
import yaml
from figaroh.calibration.base_calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm


class Points(BaseCalibration):
    def cost_function(self, var: np.ndarray) -> np.ndarray:
        tips = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        return self.apply_measurement_weighting(
            self._compute_logmap_residuals(self.PEE_measured, tips, position_frame="world")
        )


def urdf(given: dict[str, np.ndarray]) -> str:
    """The chain in standard D-H parameters as a URDF, in m: the link transform of a joint is the origin of the next."""
    n = given["alpha"].size
    links = "".join(f'<link name="link_{i}"/>' for i in range(n + 1)) + '<link name="tip"/>'
    origins = [(0.0, 0.0, 0.0), *zip(given["a"] / 1e3, given["d"] / 1e3, given["alpha"], strict=True)]
    joints = "".join(
        f'<joint name="joint_{i + 1}" type="revolute"><parent link="link_{i}"/><child link="link_{i + 1}"/>'
        f'<origin xyz="{a} 0 {d}" rpy="{alpha} 0 0"/><axis xyz="0 0 1"/>'
        '<limit lower="-6.3" upper="6.3" effort="1" velocity="1"/></joint>'
        for i, (a, d, alpha) in enumerate(origins[:-1])
    )
    a, d, alpha = origins[-1]
    last = f'<origin xyz="{a} 0 {d}" rpy="{alpha} 0 0"/>'
    tip = f'<joint name="tip_joint" type="fixed"><parent link="link_{n}"/><child link="tip"/>{last}</joint>'
    return f'<robot name="arm">{links}{joints}{tip}</robot>'


def table(path: Path, q: np.ndarray, points: np.ndarray) -> None:
    columns = {f"{axis}1": points[:, i] / 1e3 for i, axis in enumerate("xyz")}
    pd.DataFrame(columns | {f"joint_{i + 1}": q[:, i] for i in range(q.shape[1])}).to_csv(path, index=False)


def main(source: str, target: str) -> None:
    given, folder = dict(np.load(source)), Path(source).parent
    (folder / "arm.urdf").write_text(urdf(given))
    table(folder / "used.csv", given["q"], given["points"])
    table(folder / "unseen.csv", given["q_unseen"], given["points_unseen"])
    calibration = {
        "enabled": True,
        "parameters": {
            "calibration_level": "full_params",
            "include_non_geometric": bool(given["elastic"]),
            "outlier_threshold": 1.0,
            "estimation": {"method": str(given["estimation"])},
        },
        "kinematics": {"base_frame": "universe", "tool_frame": "tip"},
        "measurements": {
            "markers": [
                {
                    "name": "reflector",
                    "reference_joint": f"joint_{given['alpha'].size}",
                    "measurable_dof": [True] * 3 + [False] * 3,
                }
            ],
            "poses": {"base_pose": None, "tool_pose": None},
        },
        "data": {
            "source_file": str(folder / "used.csv"),
            "validation_data_file": str(folder / "unseen.csv"),
            "number_of_samples": len(given["q"]),
        },
    }
    joints = [f"joint_{i + 1}" for i in range(given["alpha"].size)]
    config = {"robot": {"name": "arm", "properties": {"joints": {"active_joints": joints}}}}
    (folder / "arm.yaml").write_text(yaml.safe_dump(config | {"tasks": {"calibration": calibration}}))
    robot = pin.RobotWrapper.BuildFromURDF(str(folder / "arm.urdf"))
    begin = time.process_time()
    calibrator = Points(robot, str(folder / "arm.yaml"))
    calibrator.calib_config |= {"known_baseframe": False, "known_tipframe": False}
    calibrator.initialize()
    calibrator.solve(enable_logging=False)
    seconds = time.process_time() - begin
    config = dict(calibrator.calib_config, NbSample=len(given["q_unseen"]))
    tips = calc_updated_fkm(calibrator.model, calibrator.data, calibrator.LM_result.x, given["q_unseen"], config)
    points = np.asarray(tips).reshape(-1, len(given["q_unseen"]))[:3].T * 1e3
    names = np.array(calibrator.calib_config["param_name"])
    np.savez(target, points=points, seconds=seconds, names=names, values=calibrator.LM_result.x)


if __name__ == "__main__":
    main(*sys.argv[1:])
