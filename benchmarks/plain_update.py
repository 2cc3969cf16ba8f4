"""
One update of DDiffPG as a plain implementation would write it, the oracle of ``bench_update.py``: a separate network for each
critic, time embeddings for every row, the whole first layer at every denoising step, the ascent through a graph that keeps the
weights' gradients, novelty asked twice. The networks hold the weights of a model, so that both compute the same values.
"""

import copy
from typing import Any

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.networks.critics import project_distribution


class PlainCritic(nn.Module):
    """
    One critic of one group.

    :param critics: The stacked critics of a model
    :param group: Which group
    :param twin: Which of its critics
    """

    def __init__(self, critics: Any, group: int, twin: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for weight, bias in zip(critics.weights, critics.biases, strict=True):
            linear = nn.Linear(weight.shape[2], weight.shape[3])
            linear.weight.data.copy_(weight.data[group, twin].T)
            linear.bias.data.copy_(bias.data[group, twin, 0])
            layers += [linear, copy.deepcopy(critics.activation)]
        self.net = nn.Sequential(*layers[:-1])

    def forward(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self.net(th.cat((features, actions), dim=-1))


class PlainDenoiser(nn.Module):
    """
    The noise predictor with one first layer for everything.

    :param denoiser: A model's
    """

    def __init__(self, denoiser: Any) -> None:
        super().__init__()
        self.time_mlp = copy.deepcopy(denoiser.time_mlp)
        parts = (denoiser.time_in, denoiser.condition_in, denoiser.action_in)
        self.first = nn.Linear(sum(part.in_features for part in parts), denoiser.condition_in.out_features)
        self.first.weight.data.copy_(th.cat([part.weight.data for part in parts], dim=1))
        self.first.bias.data.copy_(denoiser.condition_in.bias.data)
        self.trunk = copy.deepcopy(denoiser.trunk)

    def forward(self, actions: th.Tensor, condition: th.Tensor, steps: th.Tensor) -> th.Tensor:
        return self.trunk(self.first(th.cat((self.time_mlp(steps), condition, actions), dim=1)))


class PlainUpdate:
    """
    :param model: Whose networks are copied
    """

    def __init__(self, model: DDiffPG) -> None:
        self.model = model
        groups, twins = range(model.critics.n_groups), range(model.critics.n_critics)
        self.critics = nn.ModuleList([nn.ModuleList([PlainCritic(model.critics, g, c) for c in twins]) for g in groups])
        self.critics.to(model.device)
        self.targets = copy.deepcopy(self.critics)
        self.denoiser = PlainDenoiser(model.actor.diffusion.denoiser).to(model.device)
        self.novelty: Any = copy.deepcopy(model.bonus.novelty_model)
        self.critic_optimizers = [th.optim.AdamW(pair.parameters(), lr=5e-4, foreach=False) for pair in self.critics]
        self.actor_optimizer = th.optim.AdamW(self.denoiser.parameters(), lr=3e-4, foreach=False)

    def denoise(self, condition: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """
        :param condition: Shape [N, condition_dim]
        :param noise: Shape [T, N, action_dim]
        :return: Actions, shape [N, action_dim]
        """
        diffusion = self.model.actor.diffusion
        actions = noise[0]
        for t in reversed(range(diffusion.n_steps)):
            steps = th.full((len(actions),), t, device=actions.device)
            epsilon = self.denoiser(actions, condition, steps)
            x0 = (diffusion._x0_scale[t] * actions - diffusion._noise_scale[t] * epsilon).clamp(-1.0, 1.0)
            actions = diffusion._mean_x0[t] * x0 + diffusion._mean_xt[t] * actions
            if t > 0:
                actions = actions + diffusion._sigma[t] * noise[diffusion.n_steps - t]
        return actions

    def action_gradient(self, group: int, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param group: Whose critics
        :param features: Shape [n, F]
        :param actions: Shape [n, action_dim]
        :return: Gradient of the first critic's value, shape [n, action_dim]
        """
        actions = actions.detach().requires_grad_()
        critic: Any = self.critics[group][0]  # type: ignore[index]
        self._value(critic(features, actions), group).sum().backward()  # the weights' gradients come with it
        assert actions.grad is not None
        return actions.grad

    def _value(self, logits: th.Tensor, group: int) -> th.Tensor:
        if self.model.critics.n_atoms == 1:
            return logits[:, 0]
        return (logits.softmax(dim=-1) * self.model.critics.atoms[min(group, 1)]).sum(dim=-1)

    def __call__(self, batch_size: int) -> None:
        """
        :param batch_size: Transitions over all groups
        """
        model, policy = self.model, self.model.policy
        groups = model.exploration_settings, model.mode_settings
        n_steps = [group.n_steps_beside(model.n_steps) for group in groups]
        batch = model.replay_buffer.sample_modes(batch_size, model.gamma, *n_steps)
        n_groups, n = batch.rows.shape
        positions = model.replay_buffer.features.of_tensors(model.replay_buffer.read_observations(batch.rows[0])[1])
        features = policy.critic_features(batch.observations).detach()
        next_features = policy.critic_features(batch.next_observations).detach()
        inputs = next_features[0] if getattr(self.novelty, "with_observation", False) else positions
        self.novelty.novelty(positions, inputs)
        self.novelty.update(positions, inputs)
        improved = []
        for group in range(n_groups):
            embedding = policy.mode_embeddings[group].expand(n, -1)
            with th.no_grad():
                noise = th.randn(model.n_diffusion_steps, *batch.actions[group].shape, device=model.device)
                next_actions = self.denoise(th.cat((next_features[group], embedding), dim=1), noise)
                pair: Any = self.targets[group]
                logits = [critic(next_features[group], next_actions) for critic in pair]
                atoms = model.critics.atoms[min(group, 1)][None, None]
                projected = [
                    project_distribution(
                        each.softmax(-1)[None], atoms, batch.rewards[None, group], batch.discounts[None, group]
                    )
                    for each in logits
                ]
                target = th.minimum(*projected)[0]
            online: Any = self.critics[group]
            outputs = [critic(features[group], batch.actions[group]) for critic in online]
            losses = [F.binary_cross_entropy(each.softmax(-1), target.clamp(0, 1), reduction="none") for each in outputs]
            loss = th.stack([each.sum(-1).mean() for each in losses]).sum()
            self.critic_optimizers[group].zero_grad()
            loss.backward()
            self.critic_optimizers[group].step()
            actions = batch.target_actions[group].clone()
            mean, square, ascent_settings = th.zeros_like(actions), th.zeros_like(actions), model.target_action_settings
            for step in range(1, ascent_settings.n_steps + 1):
                ascent = self.action_gradient(group, features[group], actions)
                mean, square = 0.9 * mean + 0.1 * ascent, 0.999 * square + 0.001 * ascent.pow(2)
                ascent = (mean / (1 - 0.9**step)) / ((square / (1 - 0.999**step)).sqrt() + 1e-8)
                actions = (actions + ascent_settings.learning_rate * ascent).clamp(-1, 1)
            improved.append(actions)
        clean = th.cat(improved)
        condition = th.cat((features.flatten(0, 1), policy.mode_embeddings.repeat_interleave(n, 0)), dim=1)
        steps = th.randint(model.n_diffusion_steps, (len(clean),), device=model.device)
        noise = th.randn_like(clean)
        diffusion = model.actor.diffusion
        noisy = diffusion.sqrt_alpha_bar[steps, None] * clean + diffusion.sqrt_one_minus_alpha_bar[steps, None] * noise
        loss = (self.denoiser(noisy, condition, steps) - noise).pow(2).mean()
        self.actor_optimizer.zero_grad()
        loss.backward()
        self.actor_optimizer.step()
        for online, target in zip(self.critics.parameters(), self.targets.parameters(), strict=True):
            target.data.mul_(1 - model.tau).add_(model.tau * online.data)
