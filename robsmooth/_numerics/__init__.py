"""The matrix equations: Riccati and Lyapunov equations, exponentials, a noise over a step."""
