"""Box-bounded nonlinear least squares: Levenberg-Marquardt with an active set, and its adjoint."""
