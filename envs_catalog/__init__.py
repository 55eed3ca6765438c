"""The catalogue of fields: data files, read by :mod:`mbn_marl.field`."""
