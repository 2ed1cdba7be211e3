## fid of FOMCON with one start, called by benches/alternatives.py: octave-cli fomcon_fid.m FOMCON FOLDER
##
## FOLDER has train.csv (time, input, one output per record), test.csv (time, input) and start.csv (numerator, then pairs
## of coefficient and exponent of K/(a1 s^n1 + ... + 1)). All coefficients and exponents are free. Prints one line per
## record: processor time [s], n1, and the response to the input of test.csv.

1;  # This file is a script.

function [x, squares, residuals] = lsqnonlin (f, x0, low, high, options)
  ## FOMCON expects rows; lsqnonlin of Octave's optim package passes columns.
  settings = optimset ("lbound", low(:), "ubound", high(:));
  [x, residuals] = nonlin_residmin (@(p) f (p(:)'), x0(:), settings);
  x = x(:)';
  squares = sumsq (residuals);
end

warning ("off", "all");
pkg load optim
paths = argv ();
addpath (genpath (paths{1}));
train = csvread (fullfile (paths{2}, "train.csv"));
test = csvread (fullfile (paths{2}, "test.csv"));
start = csvread (fullfile (paths{2}, "start.csv"));
model = fotf ([start(2:2:end), 1], [start(3:2:end), 0], start(1), 0);
for k = 3:columns (train)
  data = fidata (train(:, k), train(:, 2), train(:, 1));
  before = cputime ();
  evalc ("[~, powers, ~, ~, ~, found] = fid (model, {[], []}, data);");
  seconds = cputime () - before;
  printf ("%.17g ", [seconds, powers(1), lsim(found, test(:, 2), test(:, 1))']);
  printf ("\n");
end
