"""The paper's figures and tables, remade for a robot: the rooms of `mmrjax reproduce`."""
