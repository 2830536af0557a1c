"""Random and mutated inputs for everything that reads bytes from outside, guided by which lines they reach."""
