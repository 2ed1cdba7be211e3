"""An equation of four free orders, a small lattice for them and the number of pulses to search it with."""

EQUATION = "D^alpha y = a D^beta y + c D^mu y + b D^nu u"
GRID = {"alpha": [1.4, 1.6, 1.8], "beta": [0.0, 0.3, 0.6, 0.9], "mu": [0.0, 0.3, 0.6, 0.9], "nu": [0.0, 0.2]}
M = 64
