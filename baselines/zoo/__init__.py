"""Trained policies of the catalogue's fields, installed with the package: ``zoo:field_03``.

An entry is a small run folder, so that whatever takes a run takes it:
    config.json        the resolved configuration of its training
    field.yaml         the field
    policy/            policy.safetensors and policy.json
    card.json          how it was trained, with what versions, and its evaluation
    README.md          the same, to be read
"""
