model linearized_model "Drive"
  parameter Integer n = 4 "number of states";
  parameter Integer m = 2 "number of inputs";
  parameter Integer p = 2 "number of outputs";
  parameter Real x0[n] = {1.5, 120, 0.0009, 120};
  parameter Real u0[m] = {24, 0.075};

  parameter Real A[n, n] =
	[-2000, -50, 0, 0;
	250.0000000000001, -0.5, -40000, 0;
	0, 1, 0, -1;
	0, 0, 25000, -0.3];

  parameter Real B[n, m] =
	[1000, 0;
	0, 0;
	0, 0;
	0, -1250];

  parameter Real C[p, n] =
	[0, 0, 0, 0.1;
	0, 1, 0, 0];

  parameter Real D[p, m] = zeros(p, m);


  Real x[n](start=x0);
  input Real u[m](start=u0);
  output Real y[p];

  Real 'x_motor.i' = x[1];
  Real 'x_$outputAlias_motor.w' = x[2];
  Real 'x_shaft.phi_rel' = x[3];
  Real 'x_load.w' = x[4];
  Real 'u_v' = u[1];
  Real 'u_load.tau' = u[2];
  Real 'y_theta' = y[1];
  Real 'y_motor.w' = y[2];
equation
  der(x) = A * x + B * u;
  y = C * x + D * u;
end linearized_model;
