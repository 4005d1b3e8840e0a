"""Which poses to take, in which sockets, before the arm is touched."""
