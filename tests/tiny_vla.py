# SPDX-License-Identifier: Apache-2.0
"""Vision-language-action policies of LeRobot with the right structure, few weights, and no file from the Hub.

It needs transformers, which the other tests do without.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS

STATE, IMAGE, ACTION = "observation.state", "observation.images.camera", "action"
A = 2
SIZE = 28  # of images [pixels]
CHUNK = 8
PALIGEMMA = "google/paligemma-3b-pt-224"
_FEATURES: dict[str, Any] = {
    "device": "cpu",
    "input_features": {
        STATE: PolicyFeature(FeatureType.STATE, (A,)),
        IMAGE: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)),
    },
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (A,))},
}
_CHUNKS: dict[str, Any] = {**_FEATURES, "chunk_size": CHUNK, "n_action_steps": CHUNK}


def tiny_config(kind: str, folder: Path) -> PreTrainedConfig:
    """The configuration of a small policy.

    Args:
        kind: Its type, pi0, pi05, smolvla, or multi_task_dit and its objective.
        folder: A folder for what SmolVLA loads; it is written if it is missing.
    """
    name, _, objective = kind.partition(", ")
    make = PreTrainedConfig.get_choice_class(name)
    if name in ("pi0", "pi05"):
        return make(**_CHUNKS, image_resolution=(SIZE, SIZE), num_inference_steps=3)
    if name == "smolvla":
        if not folder.exists():
            write_smolvlm(folder)
        return make(
            **_CHUNKS,
            vlm_model_name=str(folder),
            resize_imgs_with_padding=(SIZE, SIZE),
            num_vlm_layers=2,
            num_steps=3,
        )
    features = {**_FEATURES, "input_features": {STATE: _FEATURES["input_features"][STATE]}}
    return make(
        **features,
        objective=objective,
        n_obs_steps=1,
        horizon=CHUNK,
        n_action_steps=CHUNK,
        hidden_dim=16,
        num_layers=1,
        num_heads=2,
        num_integration_steps=3,
        num_inference_steps=3,
        noise_scheduler_type="DDIM",
    )


@contextmanager
def tiny_weights() -> Iterator[None]:
    """A block in which pi0, pi05 and CLIP's text encoder have a few weights, and a tokenizer of a few words is at hand."""
    from lerobot.policies.pi0 import modeling_pi0
    from lerobot.policies.pi05 import modeling_pi05
    from lerobot.processor import tokenizer_processor
    from transformers import CLIPTextConfig, CLIPTextModel

    make_paligemma = modeling_pi0.PaliGemmaForConditionalGenerationWithPiGemma

    def with_few_weights(config: Any) -> Any:
        vision = config.vision_config
        vision.hidden_size = vision.intermediate_size = 16
        vision.num_hidden_layers, vision.num_attention_heads = 1, 2
        vision.projection_dim = config.text_config.hidden_size
        return make_paligemma(config=config)

    gemma = modeling_pi0.GemmaConfig(width=32, depth=2, mlp_dim=32, num_heads=2, num_kv_heads=1, head_dim=16)
    clip = CLIPTextConfig(hidden_size=16, intermediate_size=16, num_hidden_layers=1, num_attention_heads=2)
    with ExitStack() as stack:
        for module in (modeling_pi0, modeling_pi05):
            stack.enter_context(patch.object(module, "get_gemma_config", lambda _: gemma))
            stack.enter_context(
                patch.object(module, "PaliGemmaForConditionalGenerationWithPiGemma", with_few_weights)
            )
        stack.enter_context(
            patch.object(CLIPTextModel, "from_pretrained", lambda *_, **__: CLIPTextModel(clip))
        )
        stack.enter_context(
            patch.object(
                tokenizer_processor.AutoTokenizer, "from_pretrained", lambda *_, **__: tiny_tokenizer()
            )
        )
        yield


def tiny_tokenizer() -> Any:
    """A tokenizer of a few words."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    special = ["<unk>", "<pad>", "<fake_token_around_image>", "<image>", "<global-img>", "<end_of_utterance>"]
    words = {word: number for number, word in enumerate([*special, "reach", "the", "goal"])}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        unk_token="<unk>",
        pad_token="<pad>",
        additional_special_tokens=special[2:],
        extra_special_tokens={
            "fake_image_token": special[2],
            "image_token": special[3],
            "global_image_token": special[4],
            "end_of_utterance_token": special[5],
        },
    )


def write_smolvlm(
    folder: Path,
    text: dict[str, int] | None = None,
    vision: dict[str, int] | None = None,
    scale_factor: int = 2,
) -> None:
    """Writes what SmolVLA loads of its vision-language model: configuration, image processor and tokenizer.

    Args:
        folder: The folder to write.
        text: Sizes of the language model.
        vision: Sizes of the vision model.
        scale_factor: By how much it reduces an image's width and height in patches.
    """
    from transformers import SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor, SmolVLMVideoProcessor

    few: dict[str, int] = {"hidden_size": 16, "intermediate_size": 16, "num_attention_heads": 2}
    text = text or {
        **few,
        "hidden_size": 32,
        "num_hidden_layers": 2,
        "num_key_value_heads": 1,
        "head_dim": 16,
        "vocab_size": 32,
    }
    vision = vision or {**few, "num_hidden_layers": 1, "image_size": SIZE, "patch_size": 14}
    config = SmolVLMConfig(
        text_config={"model_type": "llama", **text},
        vision_config=vision,
        scale_factor=scale_factor,
        image_token_id=3,
        pad_token_id=1,
    )
    config.save_pretrained(folder)
    SmolVLMProcessor(
        image_processor=SmolVLMImageProcessor(),
        tokenizer=tiny_tokenizer(),
        video_processor=SmolVLMVideoProcessor(),
        chat_template="{{ messages }}",
    ).save_pretrained(folder)


def tiny_observation(n_robots: int = 2) -> dict[str, Any]:
    """What a policy observes after its preprocessor."""
    generator = torch.Generator().manual_seed(0)
    return {
        STATE: torch.rand(n_robots, A, generator=generator),
        IMAGE: torch.rand(n_robots, 3, SIZE, SIZE, generator=generator),
        OBS_LANGUAGE_TOKENS: torch.tensor([[6, 7, 8]]).repeat(n_robots, 1),
        OBS_LANGUAGE_ATTENTION_MASK: torch.ones(n_robots, 3, dtype=torch.bool),
        "task": ["reach the goal"] * n_robots,
    }
