"""What plans keep to by default; nothing is imported here, so that the help of the command line reads it at once."""

FARTHEST = 0.95  # part of the reach: beyond it an arm is stretched, and hardly any pose can be taken
HEIGHTS = 20.0, 1000.0  # mm above the table: a nest stands on it, and a person who stands beside it reaches no higher
TILT_DEG = 55.0  # between the tool and the normal of a socket: recorded captures of robots keep it
