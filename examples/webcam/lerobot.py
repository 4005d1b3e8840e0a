"""Writes lerobot.csv: the readings of webcam.csv as LeRobot would have reported them."""

import csv
from pathlib import Path

FOLDER = Path(__file__).parent
MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SIGNS = (-1, 1, 1, 1, 1)  # of the motors
MIDDLES = (0.0, -100.4, 90.7, 37.3, 0.0)  # deg: what a motor reads where the joint value of the model is 0
TURN = 4096 / 4095  # LeRobot takes a turn as 4095 counts

header, *rows = csv.reader((FOLDER / "webcam.csv").read_text().splitlines())
with open(FOLDER / "lerobot.csv", "w", encoding="utf-8", newline="") as file:
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["image", *(f"{motor}.pos" for motor in MOTORS), "gripper.pos"])
    for image, *joints in rows:
        read = [TURN * (s * float(q) + m) for s, q, m in zip(SIGNS, joints, MIDDLES, strict=True)]
        writer.writerow([image, *(f"{value:.3f}" for value in read), "12.500"])
