"""Checkpoints of the published implementation, in our names."""

from __future__ import annotations

import re
from collections.abc import Mapping

from torch import Tensor

__all__ = ["RENAMING", "UNUSED", "from_published"]


# Tensors of the published checkpoint that never reach its output.
UNUSED = re.compile(r"\.(m_proj|fusion[12]|embed_1)\.")


# Published name to ours, applied in this order. Sequential containers are numbered there; here layers have
# names.
RENAMING = [
    (r"^ds_1\.embed_2\.right\.0\.", "head.shortcut."),
    (r"^ds_1\.embed_2\.left\.0\.", "head.linear1."),
    (r"^ds_1\.embed_2\.left\.2\.", "head.norm1."),
    (r"^ds_1\.embed_2\.left\.4\.", "head.linear2."),
    (r"^ds_1\.embed_2\.left\.6\.", "head.norm2."),
    (r"^ds_1\.linear_2\.", "head.output."),
    (r"^ds_([01])\.", r"blocks.\1."),
    (r"\.conv\.0\.(?=weight|bias)", ".stem."),
    (r"(^blocks\.\d)\.conv\.2\.", r"\1.stem_norm."),
    (r"\.motion_embed\.0\.", ".motion.linear1."),
    (r"\.motion_embed\.1\.", ".motion.norm1."),
    (r"\.motion_embed\.3\.", ".motion.linear2."),
    (r"\.motion_embed\.4\.", ".motion.norm2."),
    (r"\.motion_embed\.6\.", ".motion.linear3."),
    (r"\.linear_([01])\.", r".rounds.\1.logit."),
    (r"\.(gab|aggregator|pool|unpool|oafilter|ltr)1\.", r".rounds.0.\1."),
    (r"\.(gab|aggregator|pool|unpool|oafilter|ltr)2\.", r".rounds.1.\1."),
    (r"\.gab\.embed\.0\.", ".explicit.embed."),
    (r"\.gab\.embed\.2\.", ".explicit.embed_norm."),
    (r"\.gab\.pointcn1\.", ".explicit.neighbor_context."),
    (r"\.gab\.pointcn2\.", ".explicit.channel_context."),
    (r"_context\.1\.", "_context.norm1."),
    (r"_context\.3\.", "_context.linear1."),
    (r"_context\.5\.", "_context.norm2."),
    (r"_context\.7\.", "_context.linear2."),
    (r"\.gab\.(spatial|neighbor|channel)_att\.", r".explicit.\1_attention."),
    (r"_attention\.0\.", "_attention.squeeze."),
    (r"_attention\.1\.", "_attention.squeeze_norm."),
    (r"_attention\.3\.", "_attention.expand."),
    (r"_attention\.4\.", "_attention.expand_norm."),
    (r"\.aggregator\.conv1\.0\.", ".explicit.ring."),
    (r"\.aggregator\.conv1\.1\.", ".explicit.ring_norm."),
    (r"\.aggregator\.conv2\.0\.", ".explicit.gather."),
    (r"\.aggregator\.conv2\.1\.", ".explicit.gather_norm."),
    (r"\.(pool|unpool)\.conv\.1\.", r".implicit.\1_norm."),
    (r"\.(pool|unpool)\.conv\.3\.", r".implicit.\1."),
    (r"\.oafilter\.", ".implicit.filters."),
    (r"\.conv1\.1\.", ".norm1."),
    (r"\.conv1\.3\.", ".linear1."),
    (r"\.conv2\.0\.", ".cluster_norm."),
    (r"\.conv2\.2\.", ".cluster_linear."),
    (r"\.conv3\.2\.", ".norm2."),
    (r"\.conv3\.4\.", ".linear2."),
    (r"\.ltr\.layers\.", ".injection."),
    (r"\.self_attn\.", ".self_attention."),
    (r"\.cross_attn\.", ".motion_attention."),
    (r"\.q_proj\.", ".query."),
    (r"\.k_proj\.", ".key."),
    (r"\.v_proj\.", ".value."),
    (r"_attention\.proj\.", "_attention.output."),
    (r"\.norm1_1\.", ".query_norm."),
    (r"\.norm1_2\.", ".context_norm."),
    (r"\.norm1_3\.", ".motion_norm."),
    (r"(\.injection\.\d+)\.norm2\.", r"\1.stream_norm."),
    (r"(\.injection\.\d+)\.norm3\.", r"\1.mlp_norm."),
    (r"\.mlp\.fc1\.", ".expand."),
    (r"\.mlp\.fc2\.", ".contract."),
    (r"\.gamma$", ".layer_scale"),
]


def from_published(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """State dict of the published code as one of `CorrAdaptor`.

    Names that are not recognised are kept, so that loading can list them as unexpected.
    """
    result = {}
    for published, value in state.items():
        name = str(published).removeprefix("module.")
        if UNUSED.search(name):
            continue
        for pattern, replacement in RENAMING:
            name = re.sub(pattern, replacement, name)
        if isinstance(value, Tensor) and value.ndim == 4:
            # Convolution (out, in, 1, width) to linear layer (out, width * in): our rows hold one neighbour
            # after another.
            value = value.squeeze(2).transpose(1, 2).flatten(1)
        result[name] = value
    return result
