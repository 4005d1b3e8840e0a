"""The bench of mistakes: what a calibration says first where one thing is wrong with capture, manifest or arm."""
