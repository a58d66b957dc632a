"""Soft actor-critic (Haarnoja et al. 2018b), for comparison with the paper's TRPO.

One update: the batch enters a replay memory, then some steps of Adam on minibatches from it, for two Q networks, the
policy and the temperature; target networks follow softly. Loss and target updates are TorchRL's. The policy is any
module that maps observations to (mean, STD) of a diagonal Gaussian.

The Gaussian is the paper's, without the usual squashing by tanh: the table cuts actions to [-1, 1] instead. To SAC
the cut is a part of the game, whose actions are then all of the plane: the entropy is the Gaussian's own, known in
closed form, and Q(s, a) = Q(s, cut(a)) holds exactly. `QNetwork` has that built in, as it sees the cut action: without
it, it would have to extrapolate to actions that the memory holds few of, and the policy would run after its errors.
So the memory may keep either; it keeps actions as they were drawn.

Beyond the cut Q is flat, and a Gaussian out there has any STD for nothing: left alone, the means run away and the
entropy is had where it does not matter. A cost keeps the means near [-1, 1] (`outside_cost`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from airhockey_marl.algorithms.base import ALGORITHMS
from airhockey_marl.algorithms.ppo import gaussian_actor
from airhockey_marl.experiment.validation import check_counts, check_numbers, check_tensors, check_view, labeled
from airhockey_marl.players.networks import PADDLE, ObservationScaling, check_hidden, mlp_layers


@ALGORITHMS.register("sac")
@dataclass(frozen=True)
class SACConfig:
    """The settings of SAC.

    Attributes:
        capacity: transitions that the memory keeps, the newest.
        updates, minibatch: steps of Adam after each batch of play, and transitions drawn for each.
        policy_lr, q_lr, temperature_lr: step sizes of Adam.
        tau: share by which the target networks approach the Q networks at each step.
        temperature: weight of the entropy at the start, in goals per nat; it is learned.
        target_entropy: what the policy's mean entropy is held at by the temperature, in nats.
        outside_cost: goals that a mean action costs one unit beyond [-1, 1], growing with the square of the distance.
        q_hidden: sizes of the Q networks' hidden layers.
    """

    capacity: int
    updates: int
    minibatch: int
    policy_lr: float
    q_lr: float
    temperature_lr: float
    tau: float
    temperature: float
    target_entropy: float
    outside_cost: float
    q_hidden: Sequence[int]

    def __post_init__(self) -> None:
        check_counts(**labeled(self, "algorithm", "capacity", "updates", "minibatch"))
        rates = ("policy_lr", "q_lr", "temperature_lr", "temperature")
        check_numbers(above=0.0, **labeled(self, "algorithm", *rates))
        check_numbers(above=0.0, at_most=1.0, **labeled(self, "algorithm", "tau"))
        check_numbers(0.0, **labeled(self, "algorithm", "outside_cost"))
        check_numbers(**labeled(self, "algorithm", "target_entropy"))
        if not self.target_entropy < MAX_ENTROPY:
            raise ValueError(
                f"algorithm.target_entropy = {self.target_entropy} must be below {MAX_ENTROPY:.2f}, "
                "the entropy of two Gaussians with STD 1"
            )
        check_hidden(self.q_hidden, "algorithm.q_hidden")

    def learner(self, policy: nn.Module, gamma: float) -> "SACLearner":
        """Begin to train `policy`, observations to (mean, STD); `gamma` is per decision."""
        return SACLearner(self, policy, gamma)


MAX_ENTROPY = 2.0 * 0.5 * math.log(2 * math.pi * math.e)  # nats


class QNetwork(nn.Module):
    """The value of an action in a state: 12 + 2 -> hidden ReLU layers -> 1."""

    def __init__(self, hidden: Sequence[int]) -> None:
        super().__init__()
        check_hidden(hidden)
        self.inputs = ObservationScaling(PADDLE)
        self.layers = nn.Sequential(*mlp_layers(14, tuple(hidden)), nn.Linear(hidden[-1], 1))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Map observations (..., 12) and actions (..., 2) to values (..., 1)."""
        check_tensors(observation=(observation, "... 12"), action=(action, "... 2"))
        return self.layers(torch.cat([self.inputs(observation), action.clamp(-1.0, 1.0)], dim=-1))


class ReplayBuffer(nn.Module):
    """The newest transitions, in a ring: a module, so that what it holds is a state dict of tensors.

    TorchRL's replay buffers are no modules, and more than tensors is in their state. Here sampling takes torch's global
    random numbers, which a checkpoint holds anyhow.

    Args:
        capacity: transitions that it can hold.
    """

    WIDTHS = {"observation": 12, "action": 2, "reward": 1, "following": 12}  # noqa: RUF012 (never changed)

    def __init__(self, capacity: int) -> None:
        super().__init__()
        check_counts(capacity=capacity)
        for name, width in self.WIDTHS.items():
            self.register_buffer(name, torch.zeros(capacity, width))
        self.register_buffer("terminated", torch.zeros(capacity, 1, dtype=torch.bool))
        self.register_buffer("written", torch.zeros((), dtype=torch.int64))  # ever

    def __len__(self) -> int:
        return min(int(self.written), len(self.reward))

    def extend(self, view: TensorDictBase) -> None:
        """Remember a batch of play, see `learner.Learner`; the oldest makes room."""
        check_view(view)
        flat, capacity = view.reshape(-1), len(self.reward)
        flat = flat[-capacity:]
        place = (self.written + torch.arange(len(flat), device=self.written.device)) % capacity
        self.observation[place], self.action[place] = flat["observation"], flat["action"]
        self.reward[place], self.following[place] = flat["next", "reward"], flat["next", "observation"]
        self.terminated[place] = flat["next", "terminated"]
        self.written += len(flat)

    def sample(self, number: int) -> TensorDict:
        """Draw `number` transitions, with replacement, as TorchRL's losses want them.

        A round that was cut off is not over: only `terminated` is told, and the value of what would have followed
        counts.
        """
        check_counts(number=number)
        place = torch.randint(len(self), (number,))
        over = self.terminated[place]
        following = {
            "observation": self.following[place],
            "reward": self.reward[place],
            "terminated": over,
            "done": over,
        }
        return TensorDict(
            {"observation": self.observation[place], "action": self.action[place], "next": following}, [number]
        )


class SACLearner:
    """SAC at work on one policy."""

    def __init__(self, settings: SACConfig, policy: nn.Module, gamma: float) -> None:
        check_numbers(0.0, at_most=1.0, gamma=gamma)
        device = next(policy.parameters()).device
        self.settings, self.policy, self.memory = settings, policy, ReplayBuffer(settings.capacity).to(device)
        networks = [
            TensorDictModule(
                QNetwork(settings.q_hidden).to(device),
                in_keys=["observation", "action"],
                out_keys=["state_action_value"],
            )
            for _ in range(2)
        ]
        self.loss = SACLoss(
            gaussian_actor(policy),
            networks,
            num_qvalue_nets=2,
            loss_function="l2",
            alpha_init=settings.temperature,
            target_entropy=settings.target_entropy,
            deactivate_vmap=True,  # for two networks a loop is as fast
        )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.follow = SoftUpdate(self.loss, tau=settings.tau)
        self.q, self.targets = self.loss.qvalue_network_params, self.loss.target_qvalue_network_params
        self.temperature = nn.ParameterDict({"log": self.loss.log_alpha})
        groups = [
            {"params": list(policy.parameters()), "lr": settings.policy_lr},
            {"params": list(self.q.parameters()), "lr": settings.q_lr},
            {"params": list(self.temperature.parameters()), "lr": settings.temperature_lr},
        ]
        self.optimizer = torch.optim.Adam(groups, fused=True)

    def parts(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """What a checkpoint must hold; see `learner.Learner`."""
        return {
            "memory": self.memory,
            "q": self.q,
            "targets": self.targets,
            "temperature": self.temperature,
            "optimizer": self.optimizer,
        }

    def update(self, view: TensorDictBase) -> dict[str, float]:
        """Remember a batch, then learn from all that is remembered; see `learner.Learner` for the batch.

        Returns:
            What to log: losses of the Q networks (squared errors, added) and of the policy, averaged over the
            updates; temperature, in goals per nat, after them; mean STD before.
        """
        with torch.no_grad():
            self.memory.extend(view)
            std = self.policy(view["observation"])[1].mean().item()
        history = []
        for _ in range(self.settings.updates):
            batch = self.memory.sample(self.settings.minibatch)
            losses = self.loss(batch)
            outside = (self.policy(batch["observation"])[0].abs() - 1.0).clamp(min=0.0).square().sum(-1).mean()
            self.optimizer.zero_grad()
            # one backward pass for all: TorchRL keeps each loss's gradient from the others' parameters
            total = losses["loss_qvalue"] + losses["loss_actor"] + losses["loss_alpha"]
            (total + self.settings.outside_cost * outside).backward()
            self.optimizer.step()
            self.follow.step()
            history.append(torch.stack([losses["loss_qvalue"], losses["loss_actor"]]).detach())
        q_loss, actor_loss = torch.stack(history).mean(0).tolist()
        temperature = self.loss.log_alpha.exp().item()
        return {"q_loss": q_loss, "actor_loss": actor_loss, "temperature": temperature, "std": std}
