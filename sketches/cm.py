import sys; sys.path.insert(0,'sketches'); sys.path.insert(0,'.')
import numpy as np, time
import robsmooth as rs
from robsmooth.estimators.loop import open_loop
from robsmooth.systems.augmented import compact
from scipy.linalg import solve_continuous_lyapunov as lyap, expm, expm_frechet
from scipy.optimize import minimize
from dataclasses import replace
def err_grad(est, Delta):
    p=est.plant; op=open_loop(est,'smoothed','real'); n=p.n; nc=len(est.A_c)
    A=op.A+op.inputs@Delta@op.outputs
    ev=np.linalg.eigvals(A).real.max()
    if ev>=-1e-9: return np.inf,None
    P=lyap(A,-op.B@op.B.T); T,E,d=op.truth,op.estimate,op.delay
    Phi=expm(d*A); EP=E@Phi
    cross=EP@P@T.T
    val=np.trace(T@P@T.T-2*cross+E@P@E.T)
    mixed=T.T@EP; W=T.T@T+E.T@E-mixed-mixed.T
    S=lyap(A.T,-W)
    G=2*S@P
    if d>0: G=G-2*d*expm_frechet(d*A.T,E.T@T@P,compute_expm=False)
    GB=2*S@op.B
    GE=2*E@P-2*T@P@Phi.T
    C2,D21,C1,D12=p.C2_tilde,p.D21_tilde,p.C1_tilde,p.D12_tilde
    noise=p.D21_bar.copy(); noise[p.system.l:]=0
    low=slice(n,None)
    dB=G[low]@np.hstack([C2+D21@Delta@C1, D21@Delta@D12@est.C_c]).T+GB[low]@noise.T
    dA=G[low,low]
    dC=(op.inputs@Delta@D12).T@G[:,low]
    return val,(dA,dB,dC,GE[:,low])
def pack(e): return np.concatenate([e.A_c.ravel(),e.B_c.ravel(),e.C_c[e.plant.system.m:].ravel(),e.C_a.ravel()])
def unpack(x,e):
    nc=len(e.A_c); o=0; out=[]
    for sh in (e.A_c.shape,e.B_c.shape,(e.C_c.shape[0]-e.plant.system.m,nc),e.C_a.shape):
        s=int(np.prod(sh)); out.append(x[o:o+s].reshape(sh)); o+=s
    A,B,N,C=out
    return rs.Estimator(plant=e.plant,A_c=A.copy(),B_c=B.copy(),C_c=np.vstack([e.C_c[:e.plant.system.m],N]),C_a=C.copy(),C_f=e.C_f)
def flat(gr,m): dA,dB,dC,dE=gr; return np.concatenate([dA.ravel(),dB.ravel(),dC[m:].ravel(),dE.ravel()])
def const_minimax(est,rounds=8,verbose=True):
    p=est.plant; m=p.system.m
    w=rs.worst_case(est,'smoothed','real'); Ds=[np.zeros_like(w.Delta),w.Delta]
    best=(w.mean_square,est)
    # balance coordinates by estimator's state std
    for r in range(rounds):
        op=open_loop(est,'smoothed','real'); P=lyap(op.A+op.inputs@Ds[-1]@op.outputs,-op.B@op.B.T); s=np.sqrt(np.diag(P)[p.n:])
        est=rs.Estimator(plant=p,A_c=est.A_c/s[:,None]*s,B_c=est.B_c/s[:,None],C_c=est.C_c*s,C_a=est.C_a*s,C_f=est.C_f*s)
        x0=pack(est); unit=np.where(np.abs(x0)>0,1.0,1.0); t0=best[0]
        sa=np.linalg.norm(est.A_c); sb=np.linalg.norm(est.B_c); sc=np.linalg.norm(est.C_a)
        nc=len(est.A_c)
        unit=np.concatenate([np.full(est.A_c.size,sa/nc),np.full(est.B_c.size,sb/np.sqrt(nc)),np.full((est.C_c.shape[0]-m)*nc,1.0),np.full(est.C_a.size,sc/np.sqrt(nc))])
        cache={}
        def ev(y):
            k=y.tobytes()
            if k not in cache:
                cache.clear(); e=unpack(y*unit,est); vs=[];gs=[]
                for D in Ds:
                    v,g=err_grad(e,D)
                    if g is None: vs.append(50.); gs.append(np.zeros(len(y)))
                    else: vs.append(np.log(v)); gs.append(flat(g,m)*unit/v)
                cache[k]=(np.array(vs),np.array(gs))
            return cache[k]
        y0=x0/unit
        v0=ev(y0)[0].max()
        res=minimize(lambda z:z[-1],np.append(y0,v0),jac=lambda z:np.append(np.zeros(len(y0)),1.),method='SLSQP',
          constraints=[dict(type='ineq',fun=lambda z:z[-1]-ev(z[:-1])[0],jac=lambda z:np.hstack([-ev(z[:-1])[1],np.ones((len(Ds),1))]))],options=dict(maxiter=200,ftol=1e-9))
        y=res.x[:-1]
        if ev(y)[0].max()>v0: print('no progress',res.message); y=y0
        est=unpack(y*unit,est)
        w=rs.worst_case(est,'smoothed','real')
        if verbose: print(r,len(Ds),'inner',np.exp(ev(y)[0].max()),'worst',w.mean_square,'nom',w.nominal,res.nit,res.message)
        if w.mean_square<best[0]: best=(w.mean_square,est)
        if w.mean_square<=np.exp(ev(y)[0].max())*(1+1e-4): break
        Ds.append(w.Delta)
    return best
if __name__=='__main__':
    un=[rs.Uncertainty(B=[[1],[0]],C=[[0,.3]],D=[[0]])]
    def A(R=1.0): return rs.UncertainSystem([[0,-1],[1,-.5]],[[-2,0],[1,0]],[[1,0]],[[-100,100]],[[0,np.sqrt(R)]],un)
    for lag,o in ((0,0),(1,4)):
        p=compact(A(),lag,o)
        c=rs.baselines.fixed_lag_smoother(A(1000.),lag,o)
        e=rs.Estimator(plant=p,A_c=c.A_c,B_c=c.B_c,C_c=c.C_c,C_a=c.C_a,C_f=c.C_f)
        w=rs.worst_case(e,'smoothed','real'); print(lag,'tuned',w.mean_square,w.nominal)
        t=time.time(); b=const_minimax(e); print(b[0],time.time()-t)
    def sens(R=1e-3): return rs.UncertainSystem([[-1,0],[0,-2]],[[np.sqrt(2),0,0,0],[0,20,0,0]],[[1,0]],[[1,1],[0,1]],np.hstack([np.zeros((2,2)),np.sqrt(R)*np.eye(2)]),[rs.Uncertainty(B=[[0],[0]],C=[[0,.1]],D=[[0],[1]])])
    for R in (1e-3,1e-2,1e-1,1,):
        p=compact(sens(),.5,4); c=rs.baselines.fixed_lag_smoother(sens(R),.5,4)
        e=rs.Estimator(plant=p,A_c=c.A_c,B_c=c.B_c,C_c=c.C_c,C_a=c.C_a,C_f=c.C_f)
        w=rs.worst_case(e,'smoothed','real'); print(R,'tuned',w.mean_square,w.nominal)
    t=time.time(); b=const_minimax(e); print(b[0],time.time()-t)
