% The literal protocol in Octave, `width` paths side by side; see octave.py for what is defined.
rand('twister', seed); randn('twister', seed);
ends = [];
tic;
for chunk = 1:chunks
  phase = delayed = zeros(1, width);
  x = zeros(rows(drift), width);
  for k = 1:steps
    if k == steps - delay + 1
      delayed = phase;
    end
    measured = sin(phase - reference * x);
    predicted = sin(copy * x);
    noise = randn(2, width);
    x += drift * x + sine_gain * measured + copy_gain * predicted + noise_gain * noise(1, :);
    phase += decay * phase + diffusion * noise(2, :);
  end
  ends = [ends, [phase; delayed; x]];
end
seconds = toc;
printf('%.9g\n', seconds, ends);
