"""What other libraries call a setting or an environment, and what it is called here."""

import re
from collections.abc import Collection, Sequence

import gymnasium as gym

from hippo.envs import ENVIRONMENTS, foreign

# Keys of this suite, of which a learner has at most some and the first is meant: other people's words for them.
WORDS = {
    "algo.learning_rate algo.manager_learning_rate algo.actor_learning_rate": "lr learning_rate step_size stepsize "
    "pi_lr policy_lr actor_lr",
    "algo.learning_rate_decay": "anneal_lr lr_decay lr_schedule",
    "algo.critic_learning_rate": "critic_lr vf_lr value_lr qf_lr",
    "iterations": "total_timesteps total_steps total_env_steps timesteps num_timesteps n_timesteps max_steps "
    "max_timesteps n_itr n_iter iters num_iterations n_iterations max_iterations",
    "batch_size": "n_steps num_steps nsteps num_envs n_envs nenvs batch n_batch train_batch_size steps_per_epoch "
    "steps_per_batch timesteps_per_batch rollout_length",
    "algo.minibatch_size algo.manager_minibatch_size": "minibatch minibatches mini_batch_size num_minibatches "
    "n_minibatches nminibatches num_mini_batch sgd_minibatch_size",
    "algo.updates algo.updates_per_step": "n_epochs num_epochs epochs update_epochs ppo_epoch ppo_epochs noptepochs "
    "optim_epochs num_sgd_iter gradient_steps",
    "algo.clip_range": "clip cliprange clip_param clip_eps clip_epsilon clip_coef clip_ratio epsilon",
    "algo.gae_lambda": "lam lambda lmbda",
    "algo.gamma": "discount discount_factor",
    "algo.entropy_weight algo.manager_entropy_weight": "ent_coef ent_coeff entropy entropy_coef entropy_coeff "
    "entropy_bonus",
    "algo.value_loss_weight": "vf_coef vf_coeff value_coef value_coeff value_loss_coef vf_loss_coeff",
    "algo.max_gradient_norm": "max_grad_norm grad_clip grad_norm clip_grad",
    "algo.hidden_sizes algo.skill_hidden_sizes": "hidden hidden_size hidden_dim hidden_layers layers net_arch "
    "policy_hidden_sizes policy_kwargs",
    "algo.normalize_observations": "norm_obs normalize_obs obs_norm",
    "algo.scale_rewards": "norm_reward normalize_reward normalize_rewards",
    "algo.num_skills": "n_skills n_options num_options latent_dim",
    "algo.period_max algo.period": "p commitment time_commitment skill_length option_length",
    "algo.action_repeat": "frame_skip frameskip",
    "algo.replay_size": "buffer_size replay_buffer_size",
    "algo.warmup_steps": "learning_starts start_steps",
    "algo.target_kl": "kl_target max_kl kl_threshold",
    "algo.tau": "polyak",
    "env.horizon": "max_path_length max_episode_steps episode_length max_ep_len time_limit",
    "seed": "random_seed rng_seed",
    "runs_dir": "log_dir logdir output_dir out_dir save_dir run_dir",
    "wandb.mode": "wandb use_wandb track",
    "wandb.project": "project_name wandb_project wandb_project_name",
    "env": "env_id env_name env.name env.id gym_id environment task",
    "algo": "algorithm algo_name algo.name method agent",
}
KEYS = {word: keys.split() for keys, words in WORDS.items() for word in words.split()}
NOTES = {
    "iterations": "of batch_size environment steps each",
    "batch_size": "environment steps of all episodes of an iteration together",
    "algo.updates": "passes over the batch of an iteration",
}
NO_CHOICE = "no such key; a run always computes on one core of the processor"
PROCESSOR = ["device", "cuda", "gpu", "use_gpu", "use_cuda", "num_threads", "n_threads", "n_cpu", "num_workers"]


def hint(key: str, known: Collection[str]) -> str:
    """What to type instead of `key`, whatever group stands before it; "" if it is nobody's word.

    Args:
        known: the keys that the run has.
    """
    word = key.rsplit(".", 1)[-1].replace("-", "_").lower()
    if word in PROCESSOR:
        return NO_CHOICE
    ours = [k for k in known if k.rsplit(".", 1)[-1] == word] or KEYS.get(word) or KEYS.get(key, [])
    if not ours:
        return ""
    there = [k for k in ours if k in known]
    if not there:
        return f"no such key; it is called {ours[0]}, which this learner does not have"
    note = f" ({NOTES[there[0]]})" if there[0] in NOTES else ""
    return f"no such key; did you mean {there[0]}?{note}"


def environment(name: str, valid: Sequence[str]) -> str:
    """What of `valid`, or of Gymnasium's registry, somebody means by a name such as HalfCheetah-v5; "" if nothing."""
    plain = re.sub(r"^.*/|-?v\d+$|[^a-z]", "", name.lower())
    tasks = {e.robot: task for task, e in ENVIRONMENTS.items() if task in valid and task != e.robot}
    ours = {each.replace("_", ""): tasks.get(each, each) for each in valid}.get(plain)
    return " or ".join(filter(None, [ours, f"{foreign.PREFIX}{name}" if name in gym.registry else None]))
