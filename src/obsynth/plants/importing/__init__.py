"""Models of other tools as plants: python-control, scipy, sympy, pandas, MATLAB, ANDES, Modelica, FMUs."""
