import numpy as np, time, robsmooth as rs
from robsmooth import augment as compact
un=[rs.Uncertainty(B=[[1],[0]],C=[[0,.3]],D=[[0]])]
b=rs.Uncertainty(B=[[0],[0]],C=[[10,0]],D=[[1]])
def A(u,nl=[]): return rs.UncertainSystem([[0,-1],[1,-.5]],[[-2,0],[1,0]],[[1,0]],[[-100,100]],[[0,1]],u,nl)
ou=rs.UncertainSystem([[-1]],[[1,0]],[[1]],[[1]],[[0,.1]],[rs.Uncertainty(B=[[0]],C=[[.2]],D=[[1]])])
rd=rs.UncertainSystem([[-1]],[[1,0]],[[1]],[[1]],[[0,.1]],[rs.Uncertainty([[1]],[[.1]],[[0]]),rs.Uncertainty([[0]],[[.05]],[[1]])])
h=rs.homodyne.PAPER.uncertain_system()
pend=rs.UncertainSystem([[0,1],[-.8,-.3]],[[0,0],[.5,0]],[[1,0]],[[1,0]],[[0,.1]],[],[rs.Nonlinearity([[0],[1]],[[1,0]],[[0]],.2)])
mix=rs.UncertainSystem([[0,1],[-.8,-.5]],[[0,0],[.5,0]],[[1,0]],[[1,0]],[[0,.1]],[rs.Uncertainty([[0],[1]],[[0,.1]],[[0]])],[rs.Nonlinearity([[0],[1]],[[1,0]],[[0]],.2)])
toomuch=rs.UncertainSystem([[0,1],[-.8,-.5]],[[0,0],[.5,0]],[[1,0]],[[1,0]],[[0,.1]],[rs.Uncertainty([[0],[1]],[[1.,0]],[[0]])])
big=rs.UncertainSystem([[0,1],[-.8,-.3]],[[0,0],[.5,0]],[[1,0]],[[1,0]],[[0,.1]],[],[rs.Nonlinearity([[0],[1]],[[1,0]],[[0]],.7)])
for name,s,d,o in [('A1',A(un),1,4),('B1',A(un+[b]),1,4),('A0',A(un),0,0),('OU',ou,.2,4),('readme',rd,.2,4),('paper',h,3.1e-6,2),('pend',pend,.5,2),('mix',mix,.5,2),('big',big,.5,2),('toomuch',toomuch,.5,2)]:
    for out in ('smoothed','filtered'):
        p=compact(s,d,o); t=time.time()
        try: e=rs.minimax_smoother(p,out)
        except rs.InfeasibleDesignError as err: print(name,out,'REFUSED',err); continue
        t=time.time()-t
        b1=rs.analysis_bound(e,'guaranteed','real')
        print(f'{name} {out} {e.certified:.8g} {e.route} analysis {b1.mean_square:.8g} true {rs.analysis_bound(e,out,"real").mean_square:.6g} worst {rs.worst_case(e,out,"real").mean_square:.6g} nominal {rs.error_covariance(e,np.zeros_like(p.structured_delta()),out,loop="real").trace():.6g} {t:.2f}s',flush=True)
