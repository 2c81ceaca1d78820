from cm import *
def balance(est,D):
    p=est.plant; op=open_loop(est,'smoothed','real'); P=lyap(op.A+op.inputs@D@op.outputs,-op.B@op.B.T)
    P22=P[p.n:,p.n:]; T=np.linalg.cholesky(P22); Ti=np.linalg.inv(T)
    return rs.Estimator(plant=p,A_c=Ti@est.A_c@T,B_c=Ti@est.B_c,C_c=est.C_c@T,C_a=est.C_a@T,C_f=est.C_f@T)
def descend(est,Ds,iters=400,sharp=(10,100,1000,10000)):
    m=est.plant.system.m
    for s in sharp:
        est=balance(est,Ds[0]); x0=pack(est)
        sa=np.abs(np.linalg.eigvals(est.A_c)).max(); nc=len(est.A_c)
        unit=np.concatenate([np.full(est.A_c.size,sa),np.full(est.B_c.size,np.linalg.norm(est.B_c)),np.full((est.C_c.shape[0]-m)*nc,1.0),np.full(est.C_a.size,np.linalg.norm(est.C_a))])
        def f(y):
            e=unpack(y*unit,est); vs=[];gs=[]
            for D in Ds:
                v,g=err_grad(e,D)
                if g is None: return 1e3,np.zeros(len(y))
                vs.append(np.log(v)); gs.append(flat(g,m)*unit/v)
            vs=np.array(vs); w=np.exp(s*(vs-vs.max())); 
            return vs.max()+np.log(w.sum()/len(w))/s, (w/w.sum())@np.array(gs)
        r=minimize(f,x0/unit,jac=True,method='BFGS',options=dict(maxiter=iters,gtol=1e-7))
        est=unpack(r.x*unit,est)
    return est
def run(e,rounds=6):
    w=rs.worst_case(e,'smoothed','real'); Ds=[np.zeros_like(w.Delta),w.Delta]; best=(w.mean_square,w.nominal,e)
    for r in range(rounds):
        t=time.time(); e=descend(e,Ds); inner=max(err_grad(e,D)[0] for D in Ds)
        w=rs.worst_case(e,'smoothed','real')
        print(r,len(Ds),'inner',inner,'worst',w.mean_square,'nom',w.nominal,f'{time.time()-t:.1f}s')
        if w.mean_square<best[0]: best=(w.mean_square,w.nominal,e)
        if w.mean_square<=inner*(1+1e-4): break
        Ds.append(w.Delta)
    return best
if __name__=='__main__':
    un=[rs.Uncertainty(B=[[1],[0]],C=[[0,.3]],D=[[0]])]
    def A(R=1.0): return rs.UncertainSystem([[0,-1],[1,-.5]],[[-2,0],[1,0]],[[1,0]],[[-100,100]],[[0,np.sqrt(R)]],un)
    def on(p,c): return rs.Estimator(plant=p,A_c=c.A_c,B_c=c.B_c,C_c=c.C_c,C_a=c.C_a,C_f=c.C_f)
    for lag,o in ((0,0),(1,4)):
        p=compact(A(),lag,o); e=on(p,rs.baselines.fixed_lag_smoother(A(1000.),lag,o))
        print(lag,run(e)[:2])
    def sens(R=1e-3): return rs.UncertainSystem([[-1,0],[0,-2]],[[np.sqrt(2),0,0,0],[0,20,0,0]],[[1,0]],[[1,1],[0,1]],np.hstack([np.zeros((2,2)),np.sqrt(R)*np.eye(2)]),[rs.Uncertainty(B=[[0],[0]],C=[[0,.1]],D=[[0],[1]])])
    p=compact(sens(),.5,4); print(run(on(p,rs.baselines.fixed_lag_smoother(sens(.3),.5,4)))[:2])
