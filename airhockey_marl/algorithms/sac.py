"""Soft actor-critic (Haarnoja et al. 2018b), for comparison with the paper's TRPO.

One update: the batch enters a replay buffer, then some steps of Adam on minibatches from it, for two Q networks, the
policy and the temperature; soft updates of the target networks. Loss, target updates and replay buffer are TorchRL's.
The policy is any module that maps observations to (mean, STD) of a diagonal Gaussian.

The Gaussian is the paper's, without the usual squashing by tanh: the table clips actions to [-1, 1] instead. For SAC
the clipping is a part of the environment, whose action space is then the whole plane: the entropy is the Gaussian's,
known in closed form, and Q(s, a) = Q(s, clip(a)) holds exactly. `QNetwork` clips its input, and so it does not
extrapolate to actions that are rare in the replay buffer, where the policy would exploit its errors. The replay buffer
holds the actions before clipping.

Outside of [-1, 1] Q is constant, so entropy costs nothing there: without a countermeasure the means diverge. A cost
keeps them near [-1, 1] (`outside_cost`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer, TensorStorage
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.algorithms.ppo import gaussian_actor
from airhockey_marl.experiment.validation import check_counts, check_numbers, labeled
from airhockey_marl.players.networks import PADDLE, ObservationScaling, check_hidden, mlp_layers

MAX_ENTROPY = 2.0 * 0.5 * math.log(2 * math.pi * math.e)  # nats, of two Gaussians with STD 1


@ALGORITHMS.register("sac")
@dataclass(frozen=True)
class SACConfig:
    """The configuration of SAC.

    Attributes:
        capacity: of the replay buffer, in transitions.
        updates, batch_size: steps of Adam after each batch, and transitions sampled for each step.
        policy_lr, q_lr, temperature_lr: step sizes of Adam.
        tau: fraction of the way from the target networks to the Q networks at each soft update.
        temperature: initial weight of the entropy, in goals per nat; it is learned.
        target_entropy: of the policy, in nats, to which the temperature adapts.
        outside_cost: cost in goals of a mean action one unit outside of [-1, 1]; grows with the square of the distance.
        q_hidden: sizes of the Q networks' hidden layers.
    """

    capacity: int
    updates: int
    batch_size: int
    policy_lr: float
    q_lr: float
    temperature_lr: float
    tau: float
    temperature: float
    target_entropy: float
    outside_cost: float
    q_hidden: Sequence[int]

    def __post_init__(self) -> None:
        check_counts(**labeled(self, "algorithm", "capacity", "updates", "batch_size"))
        rates = ("policy_lr", "q_lr", "temperature_lr", "temperature")
        check_numbers(above=0.0, **labeled(self, "algorithm", *rates))
        check_numbers(above=0.0, at_most=1.0, **labeled(self, "algorithm", "tau"))
        check_numbers(0.0, **labeled(self, "algorithm", "outside_cost"))
        check_numbers(below=MAX_ENTROPY, **labeled(self, "algorithm", "target_entropy"))
        check_hidden(self.q_hidden, "algorithm.q_hidden")

    def learner(self, policy: nn.Module, gamma: float) -> "SACLearner":
        return SACLearner(self, policy, gamma)


class QNetwork(nn.Module):
    """The value of an action in a state: 12 + 2 -> hidden ReLU layers -> 1."""

    def __init__(self, hidden: Sequence[int]) -> None:
        super().__init__()
        self.inputs = ObservationScaling(PADDLE)
        self.layers = nn.Sequential(*mlp_layers(14, tuple(hidden)), nn.Linear(hidden[-1], 1))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Map observations (..., 12) and actions (..., 2) to values (..., 1)."""
        return self.layers(torch.cat([self.inputs(observation), action.clamp(-1.0, 1.0)], dim=-1))


class ReplayBuffer(nn.Module):
    """The newest `capacity` transitions: TorchRL's replay buffer as a module, whose state dict a checkpoint can hold.

    Sampling uses torch's global random numbers, which a checkpoint holds as well.
    """

    def __init__(self, capacity: int, device: torch.device | str = "cpu") -> None:
        super().__init__()
        next_step = {"observation": torch.zeros(12), "reward": torch.zeros(1), "terminated": torch.zeros(1).bool()}
        transition = TensorDict({"observation": torch.zeros(12), "action": torch.zeros(2), "next": next_step})
        self.keys = list(transition.keys(include_nested=True, leaves_only=True))
        self.transitions = transition.expand(capacity).to(device).contiguous()
        for name, tensor in self.transitions.flatten_keys("_").items():
            self.register_buffer(name, tensor)  # the same memory
        self.buffer = TensorDictReplayBuffer(storage=TensorStorage(self.transitions, device=device))
        self.buffer.empty()

    def __len__(self) -> int:
        return len(self.buffer)

    def get_extra_state(self) -> Tensor:
        """The index of the next write and the number of transitions: the part of the state dict that is no buffer."""
        return torch.tensor([self.buffer.writer.state_dict()["_cursor"], len(self)])

    def set_extra_state(self, state: Tensor) -> None:
        cursor, length = state.tolist()
        self.buffer.writer.load_state_dict({"_cursor": cursor})
        self.buffer.storage.load_state_dict({**self.buffer.storage.state_dict(), "_len": length})

    def extend(self, batch: TensorDictBase) -> None:
        """Add a batch of transitions, see `base.Learner`; they replace the oldest."""
        transitions = batch.select(*self.keys).reshape(-1)
        self.buffer.extend(transitions[-len(self.transitions) :])

    def sample(self, count: int) -> TensorDict:
        """Draw transitions with replacement.

        `done` is `terminated`: after a truncated round the value of the next observation counts.
        """
        transitions = self.buffer.sample(count)
        transitions["next", "done"] = transitions["next", "terminated"]
        return transitions


class SACLearner:
    """A policy and its Q networks in training by SAC."""

    def __init__(self, config: SACConfig, policy: nn.Module, gamma: float) -> None:
        device = next(policy.parameters()).device
        self.config, self.policy, self.replay_buffer = config, policy, ReplayBuffer(config.capacity, device)
        networks = [
            TensorDictModule(
                QNetwork(config.q_hidden).to(device), in_keys=["observation", "action"], out_keys=["state_action_value"]
            )
            for _ in range(2)
        ]
        self.loss = SACLoss(
            gaussian_actor(policy),
            networks,
            num_qvalue_nets=2,
            loss_function="l2",
            alpha_init=config.temperature,
            target_entropy=config.target_entropy,
            deactivate_vmap=True,  # for two networks a loop is as fast
        )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.target_update = SoftUpdate(self.loss, tau=config.tau)
        self.q, self.target_q = self.loss.qvalue_network_params, self.loss.target_qvalue_network_params
        self.temperature = nn.ParameterDict({"log": self.loss.log_alpha})
        groups = [
            {"params": list(policy.parameters()), "lr": config.policy_lr},
            {"params": list(self.q.parameters()), "lr": config.q_lr},
            {"params": list(self.temperature.parameters()), "lr": config.temperature_lr},
        ]
        self.optimizer = torch.optim.Adam(groups, fused=True)

    def modules(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        return {
            "replay_buffer": self.replay_buffer,
            "q": self.q,
            "target_q": self.target_q,
            "temperature": self.temperature,
            "optimizer": self.optimizer,
        }

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Add a batch to the replay buffer, then train on samples of it; see `base.Learner` for the batch.

        Returns:
            q_loss (squared errors of both Q networks, added) and actor_loss, means over the updates; temperature after
            them, in goals per nat; mean STD before.
        """
        with torch.no_grad():
            self.replay_buffer.extend(batch)
            std = self.policy(batch["observation"])[1].mean().item()
        history = []
        for _ in range(self.config.updates):
            sample = self.replay_buffer.sample(self.config.batch_size)
            losses = self.loss(sample)
            excess = (self.policy(sample["observation"])[0].abs() - 1.0).clamp(min=0.0).square().sum(-1).mean()
            self.optimizer.zero_grad()
            # one backward pass suffices: TorchRL detaches each loss from the parameters of the others
            total = losses["loss_qvalue"] + losses["loss_actor"] + losses["loss_alpha"]
            (total + self.config.outside_cost * excess).backward()
            self.optimizer.step()
            self.target_update.step()
            history.append(torch.stack([losses["loss_qvalue"], losses["loss_actor"]]).detach())
        q_loss, actor_loss = torch.stack(history).mean(0).tolist()
        temperature = self.loss.log_alpha.exp().item()
        return {"q_loss": q_loss, "actor_loss": actor_loss, "temperature": temperature, "std": std}
