"""Steps 3.3 and 3.5: Laplace's equation on the columns, its solvers, and the repair after them."""
