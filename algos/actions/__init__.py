"""What the action of a policy stands for."""
