"""A commented template of an arm file, valid as it stands."""

from ..core.errors import InputError

_MOST = 20
# alpha, a, d, joint by joint, as often as needed: of a small measuring arm (shoulder, elbow, wrist), and of a shorter
# chain, whose tip still reaches a volume.
_ROWS = ((-90, 0, 300), (90, 0, 0), (-90, 0, 400), (90, 0, 0), (-90, 0, 400), (90, 0, 0))
_FEW_ROWS = ((-90, 0, 300), (90, 300, 0), (-90, 0, 0), (90, 100, 0), (0, 0, 0))


def arm_template(joints: int = 6) -> str:
    """The text of an arm file (TOML) in which every key is explained.

    Args:
        joints: Number of joints.

    Raises:
        InputError: The number is not between 1 and 20.
    """
    if not 1 <= joints <= _MOST:
        raise InputError(f"an arm of {joints} joints cannot be written; give a number from 1 to {_MOST}.")
    pattern = _FEW_ROWS if joints < len(_ROWS) else _ROWS
    rows = [pattern[i % len(pattern)] if i + 1 < joints else (0, 0, 0) for i in range(joints)]
    lines = [
        f"  {{ alpha = {alpha:3d}, a = {a:3d}, d = {d:3d}, theta = 0, limits = [-170, 170] }},  # joint {number}"
        for number, (alpha, a, d) in enumerate(rows, start=1)
    ]
    return _TEMPLATE.format(rows="\n".join(lines), last=joints)


_TEMPLATE = """\
# An arm file for aacmm. Replace the numbers by those of your arm, then look at what it is taken for:
#   aacmm arm THIS_FILE --figure arm.png
# and compare it with recorded readings before anything is calibrated:
#   aacmm arm THIS_FILE --check poses.csv

name = "My arm"                   # what people call it
source = "where the numbers are from: drawing, data sheet, earlier calibration"

# Which table the rows below are:
#   "standard"  T_i = Rz(q_i + theta) Tz(d) Tx(a) Rx(alpha) [Ry(beta)]: the link after joint i is in row i.
#   "craig"     T_i = Rx(alpha) Tx(a) Rz(q_i + theta) Tz(d) (modified): the link before joint i is in row i.
# A table that looks right in the other convention gives another arm.
convention = "standard"
length_unit = "mm"                # of every length below: "mm" or "m"
angle_unit = "deg"                # of every angle below: "deg" or "rad"

# The tip (the centre of the probe's ball) in the frame of the last joint: x, y, z.
probe = [0.0, 0.0, 100.0]

# One row a joint, from the base to the tip:
#   alpha   angle from this joint's axis to the next one's, about their common normal
#   a       distance between these two axes
#   d       distance along this joint's axis between the common normals before and after it
#   theta   zero of the joint, added to its reading; left out: 0
#   limits  lowest and highest reading; for all joints or for none
#   beta    Hayati's angle, for an axis that is nearly parallel to the next (alpha near 0 or 180 deg); there d may be 0
# Readings count by the right-hand rule about the axes. If yours run the other way, keep the arm as it is and say so in
# the manifest of the capture (sign, offset, columns): aacmm arm --check finds which.
joint = [
{rows}
]

# Joints that slide along their axis instead of turning about it, by number; their limits are in length_unit.
# prismatic = [1]

# Whether readings have one more column, temperature_C: the temperature of the arm.
# thermometer = true

# Instead of the rows, a robot's own file, beside this one:
# urdf = "robot.urdf"
# base = "base_link"              # its link that does not move; left out: its root
# tip = "tool0"                   # its link at the end; left out: the only one; probe is then in its frame

# What a calibration may change. Left out, everything is free that good data determine; aacmm arm names it.
# [identification]
# held = ["theta_1", "d_1", "alpha_{last}", "a_{last}", "theta_{last}", "d_{last}"]  # fixed parameters
# free = ["beta_2"]               # free in addition, Hayati's angles
# length = 10.0                   # half-width of the bounds of lengths
# angle = 1.0                     # half-width of the bounds of angles
# override = {{ probe_z = 60.0 }}   # half-widths of single parameters

# How precise the readings are, for plans; a calibration estimates it from the data.
# [noise]
# class = "measuring arm"         # or "robot", "hobby arm"
# repeatability_mm = 0.05         # pose repeatability of ISO 9283; or:
# encoder_arcsec = 2.0            # standard deviation of a reading, one number or one a joint
# seating_mm = 0.005              # standard deviation of the tip in its seat
# source = "data sheet"

# What the maker states of the parameters: standard deviations about the nominal values, by name or group.
# [priors]
# sd = {{ lengths = 0.5, angles = 0.05 }}
# mean = {{ d_3 = 750.2 }}          # instead of the nominal value
# learn = ["theta"]               # groups whose standard deviation the data tell

# What joints do besides their readings.
# [corrections]
# model = "gravity,harmonics=1"   # also gear, coupled=2-3, expansion
#                                 # (a calibrated arm has coefficients and nominal instead)
# gravity = [0.0, 0.0, -1.0]      # its direction in the base frame
# mass = [...]                    # of each link, kg; with centre, [x, y, z] of each mass in its link's frame
"""
