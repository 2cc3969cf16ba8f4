"""What makes a policy explore: novelty, its bonus, noise, and what drives each episode."""
