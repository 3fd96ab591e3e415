"""The rules of the grammar, by area: for each rule, the node of the tree that it becomes."""
