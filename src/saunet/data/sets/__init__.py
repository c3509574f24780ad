"""The field's public data sets, each a module: where its files lie, what they mean, which frames a split has."""
