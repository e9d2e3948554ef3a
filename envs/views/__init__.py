"""Other faces of the environments: Gymnasium, PettingZoo, pictures, tables of trajectories."""
