"""A guide that proposes nothing, for tests of sessions: the real one takes most of the time and has its own tests."""


class NoGuide:
    def __init__(self, *_):
        pass

    def calibrated(self, _):
        return None

    def next_pose(self, *_):
        return None
