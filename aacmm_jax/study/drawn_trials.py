"""What a trial is drawn as, however it is drawn."""

from typing import Any, NamedTuple

from jaxtyping import Float


class DrawnTrials(NamedTuple):
    """Trials, as `identify_many` takes them; mm and rad. q is NaN where the true arm did not reach its points.

    Example:
        >>> drawn, captures = aj.study.draw_trials(study, 0, [0, 1, 2])
        >>> print(drawn.q.shape, drawn.true.shape)
        (3, 30, 6) (3, 21)
    """

    q: Float[Any, "t N n"]
    true: Float[Any, "t p"]
    lower: Float[Any, "t p"]
    upper: Float[Any, "t p"]
    start: Float[Any, "t p"]
    value: Float[Any, "t l"]  # certified values of the reference lengths
    u: Float[Any, "t l"]
