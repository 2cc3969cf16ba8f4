"""Networks: critics of all modes, the diffusion model, policies of an actor and twin critics."""
