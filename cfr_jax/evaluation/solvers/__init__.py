"""Methods as solvers of pairs: the interface that all of them have, and the networks."""
