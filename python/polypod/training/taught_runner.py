"""Distillation of many teachers, as CUDA graphs: a launch per control step and step of Adam.

In the first epoch the device learns from a control step while the simulator takes the next one.
"""

import torch
from rsl_rl.utils import check_nan
from tensordict import TensorDict

from polypod.networks.urma import counted
from polypod.training import deviations
from polypod.training.adam import give_moments, graph_adam, take_moments, tensors_of
from polypod.training.exchange import Exchange
from polypod.training.gpu_update import update_normalization
from polypod.training.graphs import Graphs
from polypod.training.runner import Runner
from polypod.training.teachers import ManyTeachers


class TaughtRunner(Runner):
    """A `Runner` of `ManyTeachers` whose student and teachers have no recurrent state.

    On a CPU it computes the same without graphs.
    """

    alg: ManyTeachers

    def _prepare(self) -> None:
        env, device = self.env, torch.device(self.device)
        if device.type == "cuda":
            # torch's idle threads would spin where the simulator's want to work
            torch.set_num_threads(1)
        self.logger.keep_on_host()
        self._steps: int = self.cfg["num_steps_per_env"]
        self._exchange = Exchange(env, self._steps)
        self._deviations, self._errors = (torch.zeros_like(self._exchange.drawn) for _ in range(2))
        self._place, self._read = (torch.zeros(1, dtype=torch.int64, device=device) for _ in range(2))
        """Control steps of the sample that is taken, and of the one that is learned from."""
        self._share = torch.zeros((), device=device)
        self._rate = torch.tensor(self.alg.learning_rate, device=device)
        self._parameters = list(self.alg.student.parameters())
        self._adam = graph_adam(self._parameters, self._rate)
        for parameter in self._parameters:
            parameter.grad = torch.zeros_like(parameter)
        self._count = 0
        """Samples that this iteration has learned from."""
        self._graphs = Graphs(device, self._changed, self.workers.count == 1)

    def _collect(self, observations: TensorDict) -> TensorDict:
        """Takes the steps of an iteration, and learns from each of them for the first time."""
        self._errors.zero_()
        self._share.fill_(self.alg.teacher_share)
        self._rate.fill_(self.alg.learning_rate)
        self._count = 0
        exchange, told = self._exchange, self._exchange.told
        for step in range(self._steps):
            exchange.observe()
            self._place.fill_(step)
            self._graphs.run("act", self._act)
            exchange.fetch_actions()
            drawn = self._event()
            self._learn()
            if drawn is not None:
                drawn.synchronize()
            exchange.step(step)
            self.logger.process_env_step(told["rewards"][step], told["dones"][step], {})
        check_nan(self.alg.storage.observations.flatten(0, 1), told["rewards"], told["dones"])
        return observations

    def _update(self, observations: TensorDict) -> dict[str, float]:
        """Learns from the stored steps in the other epochs; returns the mean losses."""
        alg = self.alg
        for _ in range(self._steps * (alg.num_learning_epochs - 1)):
            self._learn()
        update_normalization(alg.student, alg.storage.observations.flatten(0, 1))
        return alg.figures(self._errors / self._count)

    @torch.no_grad()
    def _act(self) -> None:
        """Draws the actions of a step and keeps what there is to learn from it."""
        observed = self._exchange.observed
        actions, labels, std = self.alg.choose(observed, self._share)
        self._exchange.drawn.copy_(actions)
        self._deviations.copy_(std.expand_as(actions))
        storage = self.alg.storage
        storage.privileged_actions.index_copy_(0, self._place, labels.unsqueeze(0))
        for name, samples in storage.observations.items():
            samples.index_copy_(0, self._place, observed[name].unsqueeze(0))

    def _learn(self) -> None:
        """Learns from the next sample."""
        self._read.fill_(self._count % self._steps)
        self._count += 1
        is_step = self._count % self.alg.gradient_length == 0
        if is_step and self.workers.count == 1:
            self._graphs.run("learn", self._take_step)
            return
        self._graphs.run("gradients", self._add_gradients)
        if is_step:
            self.alg.reduce_parameters()
            self._graphs.run("step", self._apply)

    def _take_step(self) -> None:
        self._add_gradients()
        self._apply()

    def _add_gradients(self) -> None:
        storage = self.alg.storage
        groups = {name: samples.index_select(0, self._read)[0] for name, samples in storage.observations.items()}
        labels = storage.privileged_actions.index_select(0, self._read)[0]
        observations = TensorDict(groups, batch_size=[len(labels)], device=labels.device)
        with counted([self.alg.student], self.alg.counts):
            errors = self.alg.errors(observations, labels)
        self.alg.loss(errors).backward()  # type: ignore[no-untyped-call]
        self._errors += errors.detach()

    def _apply(self) -> None:
        if self.alg.max_grad_norm:
            torch.nn.utils.clip_grad_norm_(self._parameters, self.alg.max_grad_norm)
        self._adam.step()
        deviations.limit(self._distribution)
        for parameter in self._parameters:
            assert parameter.grad is not None
            parameter.grad.zero_()

    def _changed(self) -> list[torch.Tensor]:
        gradients = [parameter.grad for parameter in self._parameters if parameter.grad is not None]
        storage = self.alg.storage
        samples = [storage.privileged_actions, *storage.observations.values()]
        return [self._errors, *samples, *gradients, *tensors_of(self._adam)]

    def _event(self) -> torch.cuda.Event | None:
        """The point of the device's work so far; None: on a CPU all is done."""
        drawn = self._exchange.drawn
        if not drawn.is_cuda:
            return None
        event = torch.cuda.Event()  # type: ignore[no-untyped-call]
        event.record(torch.cuda.current_stream(drawn.device))
        return event

    def _optimizer(self) -> torch.optim.Optimizer:
        return self._adam

    def _action_std(self) -> torch.Tensor:
        if deviations.of(self._distribution) is not None:
            return super()._action_std()
        mask = torch.from_numpy(self.env.unwrapped.sim.action_mask).to(self._deviations.device)
        return self._deviations[mask]

    def _give_to_rsl_rl(self) -> None:
        give_moments(self._adam, self.alg.optimizer)

    def _take_from_rsl_rl(self) -> None:
        take_moments(self._adam, self.alg.optimizer)
