import sys; sys.path.insert(0,'.')
import numpy as np, time, collections, robsmooth as rs
from tests.helpers.strategies import random_system
from dataclasses import replace
cnt=collections.Counter(); ts=[]; bad=[]
for seed in range(60):
    rng=np.random.default_rng(seed); g=int(rng.integers(0,2))
    s=random_system(rng,n=int(rng.integers(1,5)),m=int(rng.integers(1,3)),measurements=int(rng.integers(1,3)),g=g,size=rng.uniform(.02,.5))
    if g: s=replace(s,nonlinearities=[replace(c,B=np.zeros_like(c.B)) for c in s.nonlinearities])
    p=rs.augment(s,rng.uniform(.1,1),int(rng.integers(0,3)))
    for out in ('smoothed','filtered'):
        t=time.time()
        try: e=rs.minimax_smoother(p,out)
        except rs.InfeasibleDesignError as x: cnt['refused']+=1; continue
        except Exception as x: cnt[type(x).__name__]+=1; bad.append((seed,out,repr(x)[:200])); continue
        dt=time.time()-t; ts.append(dt); cnt[e.route]+=1
        if e.route=='descent': bad.append((seed,out,'descent',p.n,e.certified,f'{dt:.1f}'))
        try: b=rs.analysis_bound(e,'guaranteed','real').mean_square
        except Exception as x: bad.append((seed,out,'analysis',e.route,e.certified,repr(x)[:150])); continue
        if not abs(b/e.certified-1)<1e-5: bad.append((seed,out,'cert',b,e.certified))
print(cnt,np.quantile(ts,[.5,.9,1])); [print(*b) for b in bad]
s=rs.UncertainSystem([[-1.]],[[0.,0.]],[[1.]],[[1.]],[[0,.1]],[rs.Uncertainty([[1.]],[[.1]],[[0.]])])
try: print(rs.minimax_smoother(rs.augment(s,.2,2)))
except Exception as x: print(type(x),x)
