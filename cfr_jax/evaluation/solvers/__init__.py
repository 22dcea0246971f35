"""Methods as what solves pairs: what every solver answers, and the networks as solvers."""
